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
# The few that failed run again, once and one by one. ctest leaves their names in a file.
run_ctest() {
  local left=$build/Testing/Temporary
  rm -f "$left/LastTestsFailed.log"
  ctest --test-dir "$build" -j "$jobs" --output-on-failure --no-tests=error && return
  [[ -f $left/LastTestsFailed.log ]] && (($(wc -l <"$left/LastTestsFailed.log") <= most_run_again)) || return 1
  cp "$left/LastTest.log" "$logs/ctest-first.log" # the next run writes another
  echo "$again"
  ctest --test-dir "$build" --rerun-failed --output-on-failure
}
# First side by side, then one by one those that measure time. A worker steals tests from the end of another's list, so
# that most files are run by one worker, which starts their daemon once. The few that failed run again, once.
run_pytest() {
  local side_by_side=0 alone=0
  python -m pytest -q -rfEs -n "$jobs" --dist worksteal -m "not alone" tests || side_by_side=$?
  grep -lr --include='test_*.py' 'pytest\.mark\.alone' tests | xargs python -m pytest -q -rfEs -m alone || alone=$?
  ((side_by_side + alone > 0)) || return 0
  ((side_by_side <= 1 && (alone <= 1 || alone == 123))) || return 1  # no test: 1, of xargs 123, says that tests failed
  (($(grep -cE '^(FAILED|ERROR) ' "$logs/pytest.log") <= most_run_again)) || return 1
  echo "$again"
  python -m pytest -q -rfEsp --last-failed --last-failed-no-failures none tests
}
run_vitest() { (cd clients/web && npm run --silent test); }
run_e2e() { (cd clients/web && npm run --silent e2e); }

# A busy machine makes fewer tests fail; if more do, the code is wrong.
most_run_again=5
again="==== what failed, again"

# A log without colours.
plain() { sed -E 's/\x1b\[[0-9;]*m//g' "$1"; }

# The line with which a runner reports its totals; ctest has two if tests ran again, pytest then three.
closing_line() {
  local pattern lines=1
  case $1 in
    lint) pattern='^lint: ' ;;
    ctest)
      pattern='tests passed.* out of'
      lines=2
      ;;
    pytest)
      pattern='(passed|failed|error|skipped|no tests ran).* in [0-9.]+s'
      lines=3
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
      "$(grep -qx "$again" "$logs/ctest.log" && echo "$logs/ctest-first.log" || echo "$build/Testing/Temporary/LastTest.log")" ;;
    pytest) sed -nE 's/^SKIPPED (.*)/\1/p' "$logs/$1.log" ;;
    *) sed -nE 's/^skipped: (.*)/\1/p' "$logs/$1.log" ;;
  esac
}

# Names of the tests that failed, each with the first line of its reason where the runner says it.
failures() {
  local log=$logs/$1.log
  case $1 in
    lint) grep -E '(error|Error|FAILED)' "$log" | head -n 5 ;;
    ctest) last_run "$log" | ctest_failures ;;
    pytest) last_run "$log" | grep -E '^(FAILED|ERROR) ' ;;
    *)
      plain "$log" | awk '/^ *FAIL / { name = $0; next } name != "" && NF { print name ": " $0; name = "" }
        /^page of the test that failed: / { print }'
      ;;
  esac | cut -c 1-400 | sort -u | head -n 20
}

# Tests that share two cores with daemons, or with a browser that draws in software, run again.
passed_again() {
  local log=$logs/$1.log
  case $1 in
    ctest | pytest)
      grep -qx "$again" "$log" || return 0
      comm -12 <(first_run "$log" | "$1_names") <(last_run "$log" | "$1_passed")
      ;;
    *) plain "$log" | grep -E '^ *✓ .*\(retry x[0-9]+\)' | sed -E 's/^ *✓ *//' ;;
  esac
}
# A log up to the tests that ran again, and from there on; all of it if none did.
first_run() { sed "/^$again\$/,\$d" "$1"; }
last_run() { if grep -qx "$again" "$1"; then sed "1,/^$again\$/d" "$1"; else cat "$1"; fi; }
ctest_failures() { sed -nE 's/^[[:space:]]*[0-9]+ - (.*) \((Failed|Timeout|SEGFAULT|Not Run|.*Abort.*|.*xception.*)\).*/\1: \2/p'; }
ctest_names() { ctest_failures | sed -E 's/: [^:]*$//' | sort -u; }
ctest_passed() { sed -nE 's/^ *[0-9]+\/[0-9]+ Test +#[0-9]+: (.*[^.]) \.+ +Passed .*/\1/p' | sort -u; }
pytest_passed() { sed -nE 's/^PASSED ([^ ]+).*/\1/p' | sort -u; }
pytest_names() { sed -nE 's/^(FAILED|ERROR) ([^ ]+).*/\2/p' | sort -u; }

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
