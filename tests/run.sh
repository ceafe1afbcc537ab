#!/usr/bin/env bash
# Runs every test of every language, one runner after the other, and closes with one line for each runner.
# A runner that fails does not stop the others. The end repeats which tests were skipped, which passed only when they ran
# again, and which failed, and why.
#
#   tests/run.sh [lint] [ctest] [pytest] [vitest] [e2e]     default: all of them
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
build=${BUILD:-build}
logs=$build/test-logs
jobs=${JOBS:-$(.setup/cores.sh)}
mkdir -p "$logs"
export PATH=$PWD/.venv/bin:$PATH
# gRPC asks a proxy for loopback, too.
export no_proxy=${no_proxy:+$no_proxy,}127.0.0.1,localhost,::1

run_lint() { tests/lint.sh; }
run_ctest() { ctest --test-dir "$build" -j "$jobs" --output-on-failure --no-tests=error; }
# First side by side, then one by one those that measure time. A worker steals tests from the end of another's list, so
# that most files are run by one worker, which starts their daemon once.
run_pytest() {
  local status=0
  python -m pytest -q -rfEs -n "$jobs" --dist worksteal -m "not alone" tests || status=$?
  grep -lr --include='test_*.py' 'pytest\.mark\.alone' tests | xargs python -m pytest -q -rfEs -m alone || status=$?
  return "$status"
}
run_vitest() { (cd clients/web && npm run --silent test); }
run_e2e() { (cd clients/web && npm run --silent e2e); }

# A log without colours.
plain() { sed -E 's/\x1b\[[0-9;]*m//g' "$1"; }

# The line with which a runner reports its totals, and the two of pytest.
closing_line() {
  local pattern lines=1
  case $1 in
    lint) pattern='^lint: ' ;;
    ctest) pattern='tests passed.* out of' ;;
    pytest)
      pattern='(passed|failed|error|skipped|no tests ran).* in [0-9.]+s'
      lines=2
      ;;
    *) pattern='^ *Tests +' ;;
  esac
  plain "$logs/$1.log" | grep -E "$pattern" | tail -n "$lines" |
    sed -E 's/^[ =]+//; s/[ =]+$//' | paste -sd '+' | sed 's/+/ + /g'
}

skipped() {
  case $1 in
    # ctest itself prints names without reasons. Its log has GoogleTest's reason on the line after "file:line: Skipped".
    ctest) awk '/: Skipped$/ { getline; count[$0]++ } END { for (reason in count) print count[reason] ": " reason }' \
      "$build/Testing/Temporary/LastTest.log" ;;
    pytest) sed -nE 's/^SKIPPED (.*)/\1/p' "$logs/$1.log" ;;
    *) sed -nE 's/^skipped: (.*)/\1/p' "$logs/$1.log" ;;
  esac
}

# Names of the tests that failed, each with the first line of its reason where the runner says it.
failures() {
  local log=$logs/$1.log
  case $1 in
    lint) grep -E '(error|Error|FAILED)' "$log" | head -n 5 ;;
    ctest) sed -nE 's/^[[:space:]]*[0-9]+ - (.*) \((Failed|Timeout|SEGFAULT|Not Run|.*Abort.*|.*xception.*)\).*/\1: \2/p' "$log" ;;
    pytest) grep -E '^(FAILED|ERROR) ' "$log" ;;
    *)
      plain "$log" | awk '/^ *FAIL / { name = $0; next } name != "" && NF { print name ": " $0; name = "" }
        /^page of the test that failed: / { print }'
      ;;
  esac | cut -c 1-400 | sort -u | head -n 20
}

# Only the page's tests run again, once: they share two cores with a browser that draws in software.
passed_again() { plain "$logs/$1.log" | grep -E '^ *✓ .*\(retry x[0-9]+\)' | sed -E 's/^ *✓ *//'; }

suites=("$@")
((${#suites[@]} > 0)) || suites=(lint ctest pytest vitest e2e)
declare -A status seconds
failed=0
for suite in "${suites[@]}"; do
  echo "==== $suite"
  start=$SECONDS
  "run_$suite" 2>&1 | tee "$logs/$suite.log"
  status[$suite]=${PIPESTATUS[0]}
  seconds[$suite]=$((SECONDS - start))
done

echo
echo "==== Summary"
for suite in "${suites[@]}"; do
  verdict=passed
  if ((status[$suite] != 0)); then
    verdict=FAILED
    failed=1
  fi
  printf '%-7s %-7s %4d s  %s\n' "$suite" "$verdict" "${seconds[$suite]}" "$(closing_line "$suite")"
done
for suite in "${suites[@]}"; do
  skipped "$suite" | sed "s/^/skipped ($suite): /"
done
for suite in "${suites[@]}"; do
  passed_again "$suite" | sed "s/^/passed only when run again ($suite): /"
  if ((status[$suite] != 0)); then failures "$suite" | sed "s/^/FAILED ($suite): /"; fi
done
exit "$failed"
