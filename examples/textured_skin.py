"""Puts a picture on the demo's liver and loads it into a running daemon, so that a viewer shows it.

Shows: a skin as arrays, texture coordinates of its triangles, a picture from memory.
Needs: `tensormass run demo`, which prints `control ADDRESS`; the extras `meshes` and `plot`.
Run:   python examples/textured_skin.py ADDRESS [KEYS]     then choose the scene `textured` in the viewer
"""

import io
import sys

import matplotlib.image
import numpy as np

import tensormass as tm

SIZE_PX = 512
TISSUE, VESSEL = np.array([0.55, 0.16, 0.13]), np.array([0.30, 0.03, 0.08])


def painted_png() -> bytes:
    """Paints vessels over tissue: the lines where sums of waves are zero, the finer the shorter the waves."""
    y, x = np.mgrid[0 : 1 : SIZE_PX * 1j, 0 : 1 : SIZE_PX * 1j]
    random = np.random.default_rng(3)
    vessels = np.zeros_like(x)
    for wave_number in (12, 30, 70):
        angle, phase = random.uniform(0, 2 * np.pi, (2, 6, 1, 1))
        waves = np.sin(wave_number * (x * np.cos(angle) + y * np.sin(angle)) + phase).sum(axis=0)
        vessels = np.maximum(vessels, 0.9 * np.exp(-((waves / 0.25) ** 2)) * (12 / wave_number) ** 0.5)
    picture = TISSUE + vessels[..., None] * (VESSEL - TISSUE)
    png = io.BytesIO()
    matplotlib.image.imsave(png, picture, format="png")
    return png.getvalue()


def main() -> None:
    scene = tm.Scene.from_file("demo")
    scene.message.name = "textured"
    liver = scene.body("liver")
    vertices = np.frombuffer(liver.skin.packed.vertex_positions, "<f8").reshape(-1, 3)
    triangles = np.frombuffer(liver.skin.packed.triangles, "<u4").reshape(-1, 3)
    # Seen from above: x to the right and y up in the picture, the longer side from edge to edge.
    places = (vertices - vertices.min(axis=0))[:, :2] / np.ptp(vertices[:, :2], axis=0).max()
    liver.texture.coordinates = places[triangles].astype("<f4").tobytes()
    liver.texture.image = painted_png()
    with tm.connect(sys.argv[1], keys=sys.argv[2] if len(sys.argv) > 2 else None) as server:
        handle = server.load(scene)
        print(f"loaded {handle.name}: {len(triangles):,} triangles, a picture of {len(liver.texture.image):,} bytes")


if __name__ == "__main__":
    main()
