"""The images of docker/Dockerfile: every step runs in a bare Debian, and their programs start there as a user.

`make images` runs this and prints the sizes. `make test` does not, because it takes minutes. The stage `build` compiles
for most of an hour on two cores, so what it makes is taken from BUILD; `make images WHOLE=1` compiles it there too, and
`CUDA=OFF` without the CUDA backend.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import images
import pytest

import tensormass as tm

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / os.environ.get("BUILD", "build")
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text()
WANTED = os.environ.get("TENSORMASS_IMAGES", "")  # empty, "built" or "whole"
ARGUMENTS = {"CUDA": os.environ.get("CUDA") or ""}  # as `docker build --build-arg` gives them
PROGRAMS = ("tensormassd", "tensormass-haptic")
END_S = 60.0


def built(folder: Path) -> Path:
    """Returns a folder with what the stage `build` leaves to the others, made of this checkout."""
    made = folder / "tensormass"
    (made / "build" / "bin").mkdir(parents=True)
    for name in PROGRAMS:
        if not (BUILD / "bin" / name).is_file():
            pytest.skip(f"{name} is not built")
        subprocess.run(["strip", "-o", made / "build" / "bin" / name, BUILD / "bin" / name], check=True)
    if not (ROOT / "clients/web/dist/index.html").is_file():
        pytest.skip("the viewer is not built")
    shutil.copytree(ROOT / "clients/web/dist", made / "clients/web/dist")
    without = shutil.ignore_patterns("*.egg-info", "build", "_bundle", "__pycache__")
    shutil.copytree(ROOT / "clients/python", made / "clients/python", ignore=without)
    wheel = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*wheel, "--wheel-dir", made / "wheels", made / "clients/python"], check=True)
    return folder


@pytest.fixture(scope="module")
def builder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[images.Builder]:
    if not WANTED:
        pytest.skip("takes minutes; `make images` runs it")
    if os.geteuid() != 0:
        pytest.skip("needs root, for chroot")
    for program in ("mmdebstrap", "setpriv", "strip"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} here; `.setup/setup.sh wheel` installs mmdebstrap")
    if subprocess.run(["unshare", "--mount", "true"], capture_output=True).returncode != 0:
        pytest.skip("this machine allows no mounts")
    work = tmp_path_factory.mktemp("images")
    replaced = {} if WANTED == "whole" else {"build": built(work / "built")}
    try:
        yield images.Builder(DOCKERFILE, ROOT, work, replaced, ARGUMENTS)
    except images.BuildError as error:  # the bare Debian itself: steps run in the tests
        pytest.skip(f"no bare Debian can be made: {error}")
    finally:
        shutil.rmtree(work)


@pytest.fixture(scope="module")
def server_image(builder: images.Builder) -> images.Image:
    return builder.image("server")


@pytest.fixture(scope="module")
def viewer_image(builder: images.Builder) -> images.Image:
    return builder.image("viewer")


@contextlib.contextmanager
def running(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Runs a program of an image. It must end with status 0 after SIGTERM, which its user can send."""
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            yield process
        finally:
            inner = program_of(process)
            if inner is not None:
                os.kill(inner, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(END_S)
            process.kill()  # `unshare --kill-child` ends what is left
            process.wait(END_S)
        assert process.returncode == 0, log.read_text()


def program_of(process: subprocess.Popen[bytes]) -> int | None:
    """Id of the child of `unshare`, which has become the program."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    with contextlib.suppress(OSError):
        words = children.read_text().split()
        return int(words[0]) if words else None
    return None


def wait_for(pattern: str, log: Path, process: subprocess.Popen[bytes]) -> re.Match[str]:
    """Waits until a pattern is in a log. Fails if the program ends before."""
    deadline = time.monotonic() + END_S
    while (found := re.search(pattern, log.read_text())) is None:
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.02)
    return found


@contextlib.contextmanager
def daemon(image: images.Image, folder: Path) -> Iterator[str]:
    """Runs the daemon of an image on free ports. Yields its control address."""
    log = folder / "daemon.log"
    arguments = ["--control", "127.0.0.1:0", "--zeromq-publish", "tcp://127.0.0.1:*"]
    arguments += ["--zeromq-pose", "tcp://127.0.0.1:*", "--zenoh-listen", "tcp/127.0.0.1:0", "--backend", "cpu"]
    with running(images.starting(image, *arguments, "--log-format", "json"), log) as process:
        yield wait_for(r"(127\.0\.0\.1:[1-9]\d*)", log, process).group(1)


def fetch(url: str) -> str:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=10) as answer:
        assert answer.status == 200
        return str(answer.read().decode(errors="replace"))


def test_an_image_does_not_run_as_root(server_image: images.Image, viewer_image: images.Image) -> None:
    for image in (server_image, viewer_image):
        assert image.user.isdigit()
        assert int(image.user) > 0
        assert f":{image.user}:" in (image.root / "etc/passwd").read_text()


def test_images_are_small(
    server_image: images.Image, viewer_image: images.Image, capsys: pytest.CaptureFixture[str]
) -> None:
    with capsys.disabled():
        for name, image in (("server", server_image), ("viewer", viewer_image)):
            print(f"\nimage {name}: {image.size_bytes / 1e6:.0f} MB beside its base")
            for instruction, size in image.layers:
                print(f"  {size / 1e6:6.1f} MB  {instruction[:100]}")
    for image in (server_image, viewer_image):
        for left in (
            "usr/bin/gcc",
            "usr/bin/pip",
            "opt/tensormass/bin/pip",
            "var/lib/apt/lists/lock",
            "var/cache/apt/pkgcache.bin",
        ):
            assert not (image.root / left).exists(), f"{left} is not needed in an image"


def test_daemon_steps_a_scene_as_a_user_on_a_read_only_root(server_image: images.Image, tmp_path: Path) -> None:
    scene = tm.Scene.from_mesh(tm.grid([2, 2, 2], [0.1, 0.1, 0.1]), young_modulus_pa=4000, poisson_ratio=0.45)
    with daemon(server_image, tmp_path) as address, tm.connect(address) as server:
        handle = server.load(scene, lockstep=True)
        assert handle.step(3).step == 3


def test_haptic_client_starts(server_image: images.Image) -> None:
    told = subprocess.run(
        images.starting(dataclasses.replace(server_image, entrypoint=["tensormass-haptic"]), "--help"),
        capture_output=True,
        text=True,
        timeout=END_S,
    )
    assert told.returncode == 0, told.stderr
    assert "--scene" in told.stdout


def test_viewer_serves_its_page_and_loads_the_demo(
    server_image: images.Image, viewer_image: images.Image, tmp_path: Path
) -> None:
    log = tmp_path / "viewer.log"
    arguments = ["view", "--host", "127.0.0.1", "--port", "0", "--viewer", "/opt/viewer", "--json"]
    with daemon(server_image, tmp_path) as address:
        with running(images.starting(viewer_image, *arguments, "--server", address), log) as process:
            url = json.loads(wait_for(r"\{.*\}", log, process).group())["url"]
            names = re.findall(r'(?:src|href)="([^":]+)"', fetch(url))
            assert any(name.endswith(".js") for name in names)
            for name in names:
                fetch(urllib.parse.urljoin(url, name))
        load = images.starting(viewer_image, "load", "demo", "--server", address)
        loaded = subprocess.run(load, capture_output=True, text=True, timeout=120)
        assert loaded.returncode == 0, loaded.stderr
        with tm.connect(address) as server:
            assert server.scene("demo").positions("liver").shape[1] == 3
