#!/usr/bin/env bash
# Tries a wheel on a machine that has Python and nothing else, as a user without rights: check.py says what is tried.
#
#   tests/wheel/bare.sh WHEEL [SUITE [SOURCES]]
#
#   SUITE    Debian or Ubuntu release (default: bookworm), or the tar file of a root that has python3-venv
#   SOURCES  mirror or sources file for mmdebstrap (default: this machine's for its own release)
#
# Root is needed: mmdebstrap makes the bare root in a temporary folder, and the check runs there with its own mounts and
# processes. Those end with it, whatever happens. Without root, the check runs on this machine with python3 and sh only
# on PATH. pip uses the index, proxy and certificates of this machine.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
wheel=$(realpath "$1")
suite=${2:-bookworm}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# Settings with which pip reaches its index. LD_LIBRARY_PATH and the like stay out.
environment=(LANG=C.UTF-8)
passed='^(PIP_(EXTRA_)?INDEX_URL|PIP_TRUSTED_HOST|PIP_CERT|SSL_CERT_FILE|(https?|no|all)_proxy)$'
while read -r name; do environment+=("$name=${!name}"); done < <(compgen -e | grep -iE "$passed")

if ((EUID != 0)); then
  echo "wheel: not root, so the check runs on this machine instead of a bare $suite"
  mkdir "$work/bin" "$work/home"
  for program in python3 sh; do ln -s "$(PATH=/usr/bin:/bin command -v "$program")" "$work/bin/"; done
  env -i "${environment[@]}" PATH="$work/bin" HOME="$work/home" TMPDIR="$work" python3 "$here/check.py" "$wheel"
  exit
fi

root=$work/root
mkdir "$root"
if [[ -f $suite ]]; then
  tar -C "$root" -xf "$suite" --exclude='./dev/*'
else
  echo "wheel: making a bare $suite"
  sources=${3:-}
  own=/etc/apt/sources.list.d/debian.sources
  if [[ -z $sources && -f $own ]] && grep -q "^Suites:.*\b$suite\b" "$own"; then sources=$own; fi
  mmdebstrap --quiet --variant=minbase --include=apt,ca-certificates,python3-venv "$suite" "$root" ${sources:+"$sources"}
fi
for file in /etc/resolv.conf /etc/pip.conf /etc/ssl/certs/ca-certificates.crt; do
  if [[ -f $file ]]; then cp -L "$file" "$root$file"; fi
done
echo 'somebody:x:1000:1000::/somebody:/bin/sh' >>"$root/etc/passwd"
install -d -o 1000 -g 1000 "$root/somebody"
install -m 644 "$here/check.py" "$wheel" "$root/somebody/"
in_the_root() {
  set -e
  mount -t proc proc "$1/proc"
  mount --rbind --make-rslave /dev "$1/dev"
  chroot --userspec=1000:1000 "$1" env -i "${@:3}" PATH=/usr/bin:/bin HOME=/somebody \
    python3 /somebody/check.py "/somebody/$2"
}
export -f in_the_root
unshare --mount --pid --fork --kill-child bash -c 'in_the_root "$@"' _ "$root" "$(basename "$wheel")" "${environment[@]}"
