"""Scenes over the GPUs of a machine, and one of them that fails. Skipped with fewer than two GPUs of a kind."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_device import FAULTS, LOST, fault_maker
from trainer import DEADLINE_S, Trainer, ended, wait_until

import tensormass as tm
from tensormass.v1 import stream_pb2


@pytest.fixture
def trainer(tmp_path: Path) -> Iterator[Trainer]:
    """A daemon on two GPUs or more, and a FIFO that takes the first from it."""
    made = Trainer(tmp_path, backend="cuda", zenoh=False)
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    try:
        made.start(environment={"LD_PRELOAD": str(fault_maker()), "TENSORMASS_LOSE_DEVICE": str(fifo)})
    except AssertionError as no_device:
        pytest.skip(str(no_device))
    with tm.connect(made.endpoints["control"]) as server:
        count = server.version().device_count
    if count < 2:
        made.stop()
        pytest.skip(f"needs two GPUs of a kind: {count} here")
    yield from ended(made)


def test_scenes_are_spread_and_say_where_they_are(trainer: Trainer) -> None:
    with tm.connect(trainer.endpoints["control"]) as server:
        scenes = [server.load("demo", name=f"demo{i}") for i in range(4)]
        devices = [scene.status().device for scene in scenes]
        assert [scene.report.device for scene in scenes if scene.report is not None] == devices
        assert max(Counter(devices).values()) - min(Counter(devices).values()) <= 1, devices
        assert len(set(devices)) >= 2, devices
        wait_until(lambda: all(scene.status().step > 100 for scene in scenes))
        # What leaves makes room there.
        scenes[1].unload()
        assert server.load("demo", name="next").status().device == devices[1]
    assert "a scene has its GPU" in trainer.log.read_text()


@pytest.mark.parametrize("fault", FAULTS)
def test_a_gpu_that_fails_takes_only_its_scenes(trainer: Trainer, tmp_path: Path, fault: str) -> None:
    with tm.connect(trainer.endpoints["control"]) as server:
        first = server.load("demo", name="first")
        second = server.load("demo", name="second")
        assert first.status().device == 0
        assert second.status().device != 0
        (tmp_path / "fifo").write_bytes(FAULTS[fault])
        wait_until(lambda: first.status().state == stream_pb2.SceneStatus.STATE_FAULTED)
        wait_until(lambda: "the process lost its device" in trainer.log.read_text())
        step = second.status().step
        wait_until(lambda: second.status().step > step + 500)
        assert second.status().state == stream_pb2.SceneStatus.STATE_RUNNING
        first.unload()
        again = server.load("demo", name="first")
        assert again.status().device != 0
        wait_until(lambda: again.status().step > 100)
        # Nobody loses a scene if the daemon ends now.
        again.unload()
        assert trainer.child is not None
        assert trainer.child.running
        second.unload()
        # A daemon without scenes has none on a GPU that works.
        assert trainer.child.process.wait(DEADLINE_S) == LOST, trainer.log.read_text()
