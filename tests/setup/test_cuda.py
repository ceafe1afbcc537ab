"""The one place that decides about CUDA, with stand-ins for nvidia-smi."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def choice(folder: Path, goal: str = "build", smi: str | None = None, **settings: str) -> list[str]:
    """Returns what cuda.sh prints: setting, architectures, reason.

    smi: script that stands in for nvidia-smi; None leaves that command out.
    """
    tools = folder / "bin"
    tools.mkdir(exist_ok=True)
    for name in ("bash", "env", "grep", "paste", "sort", "tr"):
        if not (tools / name).exists():
            found = next(Path(place) / name for place in ("/usr/bin", "/bin") if (Path(place) / name).exists())
            (tools / name).symlink_to(found)
    if smi is not None:
        (tools / "nvidia-smi").write_text(f"#!/bin/sh\n{smi}\n")
        (tools / "nvidia-smi").chmod(0o755)
    ran = subprocess.run(
        [str(ROOT / ".setup/cuda.sh"), goal], env={"PATH": str(tools), **settings}, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.strip().split(" ", 2)


def test_without_a_gpu_nothing_is_compiled_and_the_reason_says_how_to_get_it(tmp_path: Path) -> None:
    setting, architectures, reason = choice(tmp_path)
    assert (setting, architectures) == ("OFF", "-")
    assert "no NVIDIA GPU" in reason
    assert "CUDA=ON" in reason


@pytest.mark.parametrize(
    ("capabilities", "architectures"),
    [("9.0", "90"), ("12.0", "120"), ("8.6\\n8.6", "86"), ("9.0\\n8.0", "80;90")],
)
def test_a_gpu_gets_its_own_generation(capabilities: str, architectures: str, tmp_path: Path) -> None:
    assert choice(tmp_path, smi=f"printf '{capabilities}\\n'")[:2] == ["ON", architectures]


@pytest.mark.parametrize("smi", ["exit 9", "echo '[N/A]'", "echo 'No devices were found'; exit 6"])
def test_an_unknown_gpu_is_taken_for_hopper_and_said(smi: str, tmp_path: Path) -> None:
    setting, architectures, reason = choice(tmp_path, smi=smi)
    assert (setting, architectures) == ("ON", "90")
    assert "does not tell" in reason


def test_what_was_asked_for_wins(tmp_path: Path) -> None:
    gpu = "echo 8.0"
    assert choice(tmp_path, smi=gpu, CUDA="OFF")[:2] == ["OFF", "-"]
    assert choice(tmp_path, smi=gpu, CUDA="ON")[:2] == ["ON", "80"]
    assert choice(tmp_path, smi=gpu, CUDA_ARCHITECTURES="75")[:2] == ["ON", "75"]
    assert choice(tmp_path, smi=gpu, CUDA="CHECK")[:2] == ["CHECK", "80"]


def test_without_a_gpu_cuda_can_be_asked_for(tmp_path: Path) -> None:
    assert choice(tmp_path, CUDA="ON")[:2] == ["ON", "90"]


@pytest.mark.parametrize("cuda", ["", "AUTO", "ON"])
@pytest.mark.parametrize("smi", [None, "echo 8.0"])
def test_a_release_has_every_generation_on_every_machine(cuda: str, smi: str | None, tmp_path: Path) -> None:
    setting, architectures, _ = choice(tmp_path, "release", smi, **({"CUDA": cuda} if cuda else {}))
    assert setting == "ON"
    assert architectures == "80-real;89-real;90-real;100"


def test_an_unknown_setting_is_refused() -> None:
    for arguments, settings in ((["build"], {"CUDA": "YES"}), (["everything"], {})):
        ran = subprocess.run(
            [str(ROOT / ".setup/cuda.sh"), *arguments], env={**os.environ, **settings}, capture_output=True, text=True
        )
        assert ran.returncode == 2
        assert "give " in ran.stderr
        assert ran.stdout == ""
