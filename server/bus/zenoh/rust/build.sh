#!/bin/sh
# Compiles the crate as a static library. Ninja calls it.
#
#   build.sh CARGO MANIFEST TARGET_DIR LOG CRATES
#
# LOG gets what cargo prints, a line for each crate that it compiles; CRATES the number of crates. Both tell
# .setup/build.py how far cargo is. A failure prints the log.
set -eu
cargo=$1 manifest=$2 target_dir=$3 log=$4 crates=$5
mkdir -p "$(dirname "$log")"
"$cargo" tree --locked --quiet --manifest-path "$manifest" --edges normal,build --prefix none --no-dedupe \
  --format '{p}' | sort -u | wc -l >"$crates"
if ! "$cargo" build --release --locked --manifest-path "$manifest" --target-dir "$target_dir" >"$log" 2>&1; then
  cat "$log"
  exit 1
fi
