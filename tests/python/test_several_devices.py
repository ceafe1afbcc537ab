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
def test_a_loss_of_one_gpu_ends_the_daemon_and_all_scenes_are_back(
    trainer: Trainer, tmp_path: Path, fault: str
) -> None:
    """CUDA gives up all GPUs of a process, also for a scene that does not step."""
    with tm.connect(trainer.endpoints["control"]) as server:
        first = server.load("demo", name="first")
        second = server.load("demo", name="second", lockstep=True)
        second.step(3)
        assert {first.status().device, second.status().device} == {0, 1}
        wait_until(lambda: all(trainer.snapshots(name) for name in ("first", "second")))
        (tmp_path / "fifo").write_bytes(FAULTS[fault])
        assert trainer.child is not None
        assert trainer.child.process.wait(DEADLINE_S) == LOST, trainer.log.read_text()
        trainer.child.stop()
    trainer.start()
    with tm.connect(trainer.endpoints["control"]) as server:
        assert {status.device for status in server.scenes()} == {0, 1}
        wait_until(lambda: server.scene("first").status().step > 0)
        assert server.scene("second").step(1).step == 4
