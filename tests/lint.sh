#!/usr/bin/env bash
# Checks format, style and types of every language, examples and tests included. The checks run side by side; what they
# say comes check by check, and the last line tells which of them failed.
#
#   tests/lint.sh
#
# Python's checks are set in clients/python/pyproject.toml, the web's in clients/web (tsconfig.json, eslint.config.js).
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export PATH=$PWD/.venv/bin:$PATH
logs=$(mktemp -d)
trap 'rm -rf "$logs"' EXIT

in_python() { cd clients/python && "$@"; }
python=(. ../../tests ../../examples ../../.setup ../../docs/site)

clang_format() {
  find server clients/haptic examples tests \( -name node_modules -o -name target \) -prune -o \
    \( -name '*.h' -o -name '*.cc' -o -name '*.cpp' -o -name '*.cu' -o -name '*.cuh' \) -print0 |
    xargs -0 -n 40 -P "$(nproc)" clang-format --dry-run --Werror
}
ruff_check() { in_python ruff check "${python[@]}"; }
ruff_format() { in_python ruff format --check "${python[@]}"; }
types_of_python() { in_python mypy; }
web() { cd clients/web && npm run --silent lint; }

checks=(web types_of_python clang_format ruff_check ruff_format)
declare -A process
for check in "${checks[@]}"; do
  "$check" >"$logs/$check" 2>&1 &
  process[$check]=$!
done
failed=()
for check in "${checks[@]}"; do
  if wait "${process[$check]}"; then continue; fi
  failed+=("$check")
  echo "---- $check"
  cat "$logs/$check"
done
if ((${#failed[@]} > 0)); then
  echo "lint: ${#failed[@]} of ${#checks[@]} checks failed: ${failed[*]}; \`make format\` repairs the format"
  exit 1
fi
echo "lint: ${#checks[@]} checks passed"
