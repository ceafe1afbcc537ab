#!/usr/bin/env bash
# Prints how many cores this machine gives: nproc does not know the quota of a container.
#
#   .setup/cores.sh [CPU_MAX]     CPU_MAX: file with the quota and its period (default: that of this machine)
set -euo pipefail
file=${1:-/sys/fs/cgroup/cpu.max}
cores=$(nproc)
if [[ -r $file ]] && read -r quota period <"$file" && [[ $quota =~ ^[0-9]+$ && $period =~ ^[1-9][0-9]*$ ]]; then
  allowed=$(((quota + period - 1) / period))
  if ((allowed < cores)); then cores=$((allowed > 0 ? allowed : 1)); fi
fi
echo "$cores"
