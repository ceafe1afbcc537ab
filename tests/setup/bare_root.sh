#!/usr/bin/env bash
# Makes a bare Debian or Ubuntu in a folder, and runs commands in it. Needs root and mmdebstrap.
#
#   tests/setup/bare_root.sh make ROOT SUITE PACKAGES [SOURCES]
#   tests/setup/bare_root.sh run ROOT USER COMMAND...
#
#   SUITE     Debian or Ubuntu release, for example bookworm; or the tar file of a root that has the packages
#   PACKAGES  what the root holds beside a minimal system, separated by commas
#   SOURCES   mirror or sources file for mmdebstrap (default: this machine's for its own release)
#   USER      root, or somebody: a user without rights, whose home is /somebody
#
# A command has mounts and processes of its own. They end with it, or with this script, whatever happens. It shares the
# network, and pip's index, proxy and certificates; nothing else of this machine's environment.
set -euo pipefail

make_root() {
  local root=$1 suite=$2 packages=$3 sources=${4:-} own=/etc/apt/sources.list.d/debian.sources file
  mkdir -p "$root"
  if [[ -f $suite ]]; then
    tar -C "$root" -xf "$suite" --exclude='./dev/*'
  else
    if [[ -z $sources && -f $own ]] && grep -q "^Suites:.*\b$suite\b" "$own"; then sources=$own; fi
    mmdebstrap --quiet --variant=minbase --include="apt,ca-certificates,$packages" "$suite" "$root" \
      ${sources:+"$sources"}
  fi
  for file in /etc/resolv.conf /etc/pip.conf "$certificates"; do
    if [[ -f $file ]]; then cp -L "$file" "$root$file"; fi
  done
  # The package ca-certificates writes its list again whenever it is installed or updated.
  if [[ -f $certificates ]]; then cp -L "$certificates" "$root$kept_certificates"; fi
  # mmdebstrap leaves the names of a machine to its installer.
  printf '127.0.0.1 localhost\n::1 localhost ip6-localhost\n' >"$root/etc/hosts"
  echo 'somebody:x:1000:1000::/somebody:/bin/sh' >>"$root/etc/passwd"
  install -d -o 1000 -g 1000 "$root/somebody"
}

# in_root ROOT USER COMMAND...: runs with the mounts of the root, in the namespaces that `unshare` has just made.
in_root() {
  set -e
  local root=$1 ids=0:0 home=/root
  if [[ $2 == somebody ]]; then ids=1000:1000 home=/somebody; fi
  mount --bind "$root" "$root"
  mount -t proc proc "$root/proc"
  mount --rbind --make-rslave /dev "$root/dev"
  exec chroot --userspec="$ids" "$root" env -i HOME="$home" "${@:3}"
}

run_in_root() {
  local root=$1 user=$2 name
  # Settings with which pip, npm, cargo and git reach their servers. LD_LIBRARY_PATH and the like stay out.
  local passed='^(PIP_(EXTRA_)?INDEX_URL|PIP_TRUSTED_HOST|(https?|no|all)_proxy)$'
  local environment=(LANG=C.UTF-8 PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin)
  while read -r name; do environment+=("$name=${!name}"); done < <(compgen -e | grep -iE "$passed")
  if [[ -f $root$kept_certificates ]]; then
    for name in PIP_CERT SSL_CERT_FILE NODE_EXTRA_CA_CERTS CARGO_HTTP_CAINFO GIT_SSL_CAINFO; do
      environment+=("$name=$kept_certificates")
    done
  fi
  export -f in_root
  exec unshare --mount --pid --fork --kill-child bash -c 'in_root "$@"' bare "$root" "$user" "${environment[@]}" "${@:3}"
}

certificates=/etc/ssl/certs/ca-certificates.crt
kept_certificates=/usr/local/share/certificates.crt
if ((EUID != 0)); then
  echo "bare_root.sh: needs root, for chroot and mounts" >&2
  exit 1
fi
case ${1:-} in
  make) make_root "${@:2}" ;;
  run) run_in_root "${@:2}" ;;
  *)
    echo "bare_root.sh: unknown task '${1:-}'; give make or run" >&2
    exit 2
    ;;
esac
