#!/usr/bin/env bash
# Tries a wheel on a machine that has Python and nothing else, as a user without rights: check.py says what is tried.
#
#   tests/wheel/bare.sh WHEEL [SUITE [SOURCES]]
#
#   SUITE    Debian or Ubuntu release (default: bookworm), or the tar file of a root that has python3-venv
#   SOURCES  mirror or sources file for mmdebstrap (default: this machine's for its own release)
#
# Root is needed: the check runs in a bare root (tests/setup/bare_root.sh). Without root, it runs on this machine with
# python3 and sh only on PATH. pip uses the index, proxy and certificates of this machine.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
bare_root=$here/../setup/bare_root.sh
wheel=$(realpath "$1")
suite=${2:-bookworm}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

if ((EUID != 0)); then
  echo "wheel: not root, so the check runs on this machine instead of a bare $suite"
  mkdir "$work/bin" "$work/home"
  for program in python3 sh; do ln -s "$(PATH=/usr/bin:/bin command -v "$program")" "$work/bin/"; done
  # Settings with which pip reaches its index. LD_LIBRARY_PATH and the like stay out.
  environment=(LANG=C.UTF-8)
  passed='^(PIP_(EXTRA_)?INDEX_URL|PIP_TRUSTED_HOST|PIP_CERT|SSL_CERT_FILE|(https?|no|all)_proxy)$'
  while read -r name; do environment+=("$name=${!name}"); done < <(compgen -e | grep -iE "$passed")
  env -i "${environment[@]}" PATH="$work/bin" HOME="$work/home" TMPDIR="$work" python3 "$here/check.py" "$wheel"
  exit
fi

echo "wheel: making a bare $suite"
"$bare_root" make "$work/root" "$suite" python3-venv "${@:3}"
install -m 644 "$here/check.py" "$wheel" "$work/root/somebody/"
"$bare_root" run "$work/root" somebody python3 /somebody/check.py "/somebody/$(basename "$wheel")"
