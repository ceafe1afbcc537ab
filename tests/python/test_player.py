"""The play head of a recording, on a clock of the test."""

from __future__ import annotations

import pytest

from tensormass_gateway.player import Player

# Irregular, as a recording is: a gap of lost frames, and two frames at one time around a pause of the scene.
TIMES_S = [0.0, 0.1, 0.2, 1.0, 1.0, 1.5]


class Clock:
    def __init__(self) -> None:
        self.now_s = 1e6

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def player(clock: Clock) -> Player:
    return Player(TIMES_S, clock)


def test_it_stands_still_at_the_first_frame_until_it_plays(player: Player, clock: Clock) -> None:
    clock.now_s += 10
    player.advance()
    assert (player.index, player.time_s, player.playing, player.wait_s()) == (0, 0.0, False, None)


@pytest.mark.parametrize(
    ("time_s", "index"),
    [
        (0.0, 0),
        (0.05, 0),
        (0.1, 1),
        (0.19, 1),
        (0.2, 2),
        (0.99, 2),
        (1.0, 4),
        (1.49, 4),
        (1.5, 5),
        (99.0, 5),
        (-1.0, 0),
    ],
)
def test_a_seek_shows_the_last_frame_at_or_before_the_time(player: Player, time_s: float, index: int) -> None:
    player.seek(time_s)
    assert player.index == index
    assert player.time_s == min(max(time_s, 0.0), 1.5)
    assert not player.playing


@pytest.mark.parametrize("speed", [0.25, 1.0, 2.0])
def test_frames_come_when_they_are_due_at_each_speed(player: Player, clock: Clock, speed: float) -> None:
    began_s = clock.now_s
    player.set_speed(speed)
    player.play()
    shown = [(0.0, 0)]
    while (wait_s := player.wait_s()) is not None and len(shown) < 10:
        # A timer may fire a little late, but not early.
        clock.now_s += wait_s + 1e-6
        player.advance()
        shown.append((clock.now_s - began_s, player.index))
    assert [index for _, index in shown] == [0, 1, 2, 4, 5]
    assert [at for at, _ in shown] == pytest.approx([time_s / speed for time_s in (0.0, 0.1, 0.2, 1.0, 1.5)], abs=1e-4)
    assert not player.playing


def test_a_late_timer_skips_frames_but_not_time(player: Player, clock: Clock) -> None:
    player.play()
    clock.now_s += 1.2
    player.advance()
    assert player.index == 4
    assert player.time_s == pytest.approx(1.2)
    assert player.wait_s() == pytest.approx(0.3)


def test_a_pause_keeps_the_place_and_playing_goes_on_from_it(player: Player, clock: Clock) -> None:
    player.play()
    clock.now_s += 0.15
    player.pause()
    clock.now_s += 100
    player.advance()
    assert player.index == 1
    assert player.time_s == pytest.approx(0.15)
    player.play()
    clock.now_s += 0.1
    player.advance()
    assert player.time_s == pytest.approx(0.25)


def test_another_speed_holds_from_now_on(player: Player, clock: Clock) -> None:
    player.play()
    clock.now_s += 0.4
    player.set_speed(0.25)
    clock.now_s += 0.4
    player.advance()
    assert player.time_s == pytest.approx(0.5)


def test_a_seek_while_it_plays_goes_on_from_there(player: Player, clock: Clock) -> None:
    player.play()
    clock.now_s += 1.2
    player.seek(0.1)
    clock.now_s += 0.05
    player.advance()
    assert player.playing
    assert player.time_s == pytest.approx(0.15)


def test_steps_go_through_every_frame_and_stop_playing(player: Player) -> None:
    player.play()
    player.step(3)
    assert (player.index, player.time_s, player.playing) == (3, 1.0, False)
    player.step(1)
    assert (player.index, player.time_s) == (4, 1.0), "the second frame of that time"
    player.step(-1)
    assert player.index == 3
    player.step(-100)
    assert (player.index, player.time_s) == (0, 0.0)
    player.step(100)
    assert (player.index, player.time_s) == (5, 1.5)


def test_it_ends_at_the_last_frame_and_plays_from_the_start_again(player: Player, clock: Clock) -> None:
    player.play()
    clock.now_s += 1e3
    player.advance()
    assert (player.index, player.time_s, player.playing) == (5, 1.5, False)
    player.play()
    assert (player.index, player.time_s, player.playing) == (0, 0.0, True)


def test_a_recording_of_one_moment_ends_at_once(clock: Clock) -> None:
    player = Player([0.0], clock)
    player.play()
    assert player.wait_s() == 0
    player.advance()
    assert not player.playing
