"""A WebSocket listener in front of a broker: `web_door.py PORT BROKER_PORT [CERT KEY]`.

Debian builds Mosquitto without WebSocket. This listener does what Mosquitto's own does: it asks for the protocol
`mqtt` and the path `/mqtt`, and carries packets in binary frames, cut anywhere.
"""

import asyncio
import http
import ssl
import sys

from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

PORT, BROKER_PORT = int(sys.argv[1]), int(sys.argv[2])
PIECE_BYTES = 5000


async def forward(socket, writer):
    try:
        async for frame in socket:
            writer.write(frame)
            await writer.drain()
    except ConnectionClosed:
        pass
    writer.close()


async def carry(socket):
    reader, writer = await asyncio.open_connection("127.0.0.1", BROKER_PORT)
    outwards = asyncio.create_task(forward(socket, writer))
    try:
        while piece := await reader.read(PIECE_BYTES):
            await socket.send(piece)
    except (ConnectionClosed, ConnectionError):
        pass
    await socket.close()
    await outwards


def check_path(socket, request):
    if request.path != "/mqtt":
        return socket.respond(http.HTTPStatus.NOT_FOUND, "no broker here\n")


async def main():
    tls = None
    if len(sys.argv) > 3:
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        tls.load_cert_chain(sys.argv[3], sys.argv[4])
    async with serve(
        carry,
        "127.0.0.1",
        PORT,
        ssl=tls,
        subprotocols=["mqtt"],
        process_request=check_path,
        max_size=None,
        ping_interval=1,
    ) as server:
        await server.serve_forever()


asyncio.run(main())
