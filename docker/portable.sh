#!/usr/bin/env bash
# Collects programs with every shared library but the C library's own into one folder that runs on another Linux machine:
#   docker/portable.sh DIR PROGRAM...
# The loader finds the libraries beside the program ($ORIGIN), so nothing needs to be installed there.
set -euo pipefail
target=$1
shift
mkdir -p "$target/lib"
for program in "$@"; do
  install -m 755 -s "$program" "$target/"
  ldd "$program" | awk '$3 ~ /^\// { print $3 }' |
    grep -vE '/(libc|libm|libdl|libpthread|librt|libresolv|ld-linux[^/]*)\.so' |
    xargs -r -I{} cp -Lu {} "$target/lib/"
  patchelf --set-rpath '$ORIGIN/lib' "$target/$(basename "$program")"
done
for library in "$target"/lib/*; do patchelf --set-rpath '$ORIGIN' "$library"; done
du -sh "$target"
