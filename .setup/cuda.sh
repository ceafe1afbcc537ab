#!/usr/bin/env bash
# Decides whether the CUDA backend is compiled, and for which GPU generations. Makefile, set-up, images and their tests
# ask here, so that there is one default.
#
#   .setup/cuda.sh [build|release]     prints: SETTING ARCHITECTURES REASON...
#
#   build    (default) CUDA=AUTO unless set: this machine's own generation if it has an NVIDIA GPU, else nothing
#   release  CUDA=ON unless set, for all generations of a release: wheels and images
#
#   CUDA=AUTO|ON|OFF|CHECK   ON needs no GPU; CHECK only checks that the code compiles
#   CUDA_ARCHITECTURES=...   generations as CMake names them; they win over the ones found here
#
# SETTING is ON, OFF or CHECK; ARCHITECTURES is `-` with OFF.
set -euo pipefail

# Ampere (A100 and, as 8.x, RTX 30), Ada, Hopper, Blackwell. Newer GPUs compile the PTX of 100 when the daemon starts.
release_architectures='80-real;89-real;90-real;100'
usual_architecture=90  # Hopper
goal=${1:-build}
architectures=${CUDA_ARCHITECTURES:-}

case $goal in
  build) setting=${CUDA:-AUTO} ;;
  release)
    setting=${CUDA:-ON}
    setting=${setting/#AUTO/ON}  # a release does not depend on the machine that makes it
    architectures=${architectures:-$release_architectures}
    ;;
  *) echo "cuda: unknown goal '$goal'; give build or release" >&2 && exit 2 ;;
esac

# The compute capabilities of this machine's GPUs, one a line; empty if the driver does not answer.
capabilities=
if [[ $setting != OFF ]]; then
  capabilities=$(nvidia-smi --query-gpu=compute_cap --format=csv,noheader 2>/dev/null || true)
fi
own=$(grep -xE '[0-9]+\.[0-9]' <<<"$capabilities" | tr -d . | sort -nu | paste -sd';' || true)

case $setting in
  AUTO)
    if ! command -v nvidia-smi >/dev/null; then
      echo "OFF - no NVIDIA GPU was found, so the daemon is built for the CPU alone; CUDA=ON builds for a GPU as well"
      exit
    fi
    if [[ -n $own ]]; then
      echo "ON ${architectures:-$own} the CUDA backend is built for this machine's GPU (compute capability" \
        "${capabilities//$'\n'/ })"
    else
      echo "ON ${architectures:-$usual_architecture} nvidia-smi does not tell the GPU's generation, so the CUDA backend is" \
        "built for $usual_architecture; CUDA_ARCHITECTURES=... names another, CUDA=OFF leaves it out"
    fi
    ;;
  ON | CHECK) echo "$setting ${architectures:-${own:-$usual_architecture}} CUDA=$setting was asked for" ;;
  OFF) echo "OFF - CUDA=OFF was asked for" ;;
  *) echo "cuda: CUDA='$setting'; give AUTO, ON, OFF or CHECK" >&2 && exit 2 ;;
esac
