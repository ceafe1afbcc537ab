"""Waits for the first frame that a page would draw: fetches the page, then watches the first scene as a browser does.

python first_frame.py URL
"""

from __future__ import annotations

import asyncio
import json
import sys
from urllib.parse import parse_qsl, urlsplit

import aiohttp

LIMIT_S = 60.0


async def first_frame(url: str) -> int:
    """Returns the size of the first frame in bytes. url: as `tensormass run` prints it, with its code."""
    parts = urlsplit(url)
    origin = f"{parts.scheme}://{parts.netloc}"
    jar = aiohttp.CookieJar(unsafe=True)  # takes cookies of addresses
    async with aiohttp.ClientSession(trust_env=False, cookie_jar=jar, headers={"Origin": origin}) as session:
        async with session.get(url) as page:
            page.raise_for_status()
            await page.read()
        async with session.post(f"{origin}/enter", json=dict(parse_qsl(parts.query))) as entered:
            entered.raise_for_status()
        async with session.ws_connect(f"{origin}/stream", origin=origin) as socket:
            async for message in socket:
                if message.type == aiohttp.WSMsgType.TEXT:
                    told = json.loads(message.data)
                    if told["type"] == "daemon" and told["scenes"]:
                        await socket.send_json({"type": "watch", "scene": told["scenes"][0]})
                elif message.type == aiohttp.WSMsgType.BINARY:
                    key = message.data.split(b"\0", 1)[0]
                    if key.endswith((b"/frame", b"/encoded_frame")):
                        return len(message.data)
    raise RuntimeError("the gateway closed the connection before the first frame")


if __name__ == "__main__":
    print(asyncio.run(asyncio.wait_for(first_frame(sys.argv[1]), LIMIT_S)))
