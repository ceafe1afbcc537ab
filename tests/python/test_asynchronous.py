"""Coroutine tests of one process do not reach into one another."""

from __future__ import annotations

import asyncio
import socket

import grpc
import pytest
from asynchronous import asynchronous

CALLS = 50
DEADLINE_S = 0.5


def _call(server: socket.socket, channels: list[grpc.aio.Channel]) -> grpc.aio.UnaryUnaryCall[bytes, bytes]:
    channels.append(grpc.aio.insecure_channel(f"127.0.0.1:{server.getsockname()[1]}"))
    method: grpc.aio.UnaryUnaryMultiCallable[bytes, bytes] = channels[-1].unary_unary("/any/call")
    return method(b"", timeout=DEADLINE_S)


@asynchronous
async def _leave_a_call(server: socket.socket, channels: list[grpc.aio.Channel]) -> None:
    call = _call(server, channels)
    await asyncio.sleep(0.01)  # the call is under way
    call.cancel()


@asynchronous
async def _outlast_it(server: socket.socket, channels: list[grpc.aio.Channel]) -> None:
    with pytest.raises(grpc.aio.AioRpcError):
        await _call(server, channels)


def test_a_call_that_ends_in_a_later_test_leaves_nothing_in_its_log(caplog: pytest.LogCaptureFixture) -> None:
    channels: list[grpc.aio.Channel] = []
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for _ in range(CALLS):
            _leave_a_call(silent, channels)
        _outlast_it(silent, channels)
    assert "Traceback" not in caplog.text


def test_a_task_that_a_test_leaves_is_cancelled() -> None:
    left: list[asyncio.Task[bool]] = []

    @asynchronous
    async def leave() -> None:
        left.append(asyncio.create_task(asyncio.Event().wait()))
        await asyncio.sleep(0)

    leave()
    assert left[0].cancelled()
