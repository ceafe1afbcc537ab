#!/usr/bin/env bash
# Makes a folder that runs on another Linux machine, where nothing is installed: the programs, and every shared library
# that they need except the C library's.
#
#   .setup/portable.sh DIR PROGRAM...      for example: .setup/portable.sh portable build/bin/tensormassd
#
# The loader finds the libraries through a path relative to the program ($ORIGIN). Needs patchelf.
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
