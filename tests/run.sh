#!/usr/bin/env bash
# Runs every test of every language, one runner after the other, and closes with one line for each runner.
# A runner that fails does not stop the others. The end repeats which tests were skipped, and why.
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
  sed -E 's/\x1b\[[0-9;]*m//g' "$logs/$1.log" | grep -E "$pattern" | tail -n "$lines" |
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
exit "$failed"
