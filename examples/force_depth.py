"""Presses a probe into the demo liver and plots force against depth.

Shows: lockstep, in which time passes only in `step`, so the tissue comes to rest at each depth.
Needs: a built daemon (`make build`) and matplotlib (`pip install "tensormass[plot]"`).
Run:   python examples/force_depth.py [FILE]        FILE: .png or .svg, default force_depth.png
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import tensormass as tm

ABOVE_M = np.array([-0.03, 0.02, 0.058])  # 3 mm above the liver
TRAVEL_M = 0.015
STRIDE_M = 0.0005
STEPS_AT_REST = 10  # each 1/60 s


def main(file: str) -> None:
    travels_m = np.arange(0.0, TRAVEL_M, STRIDE_M)
    forces_n = []
    with tm.launch() as server:
        scene = server.load("demo", lockstep=True)
        scene.move_tool("probe", ABOVE_M)
        scene.step(120)  # the liver sags under gravity
        for travel_m in travels_m:
            scene.move_tool("probe", ABOVE_M - [0.0, 0.0, travel_m])
            scene.step(STEPS_AT_REST)
            forces_n.append(np.linalg.norm(scene.feedback("probe").force_n))

    depths_mm = 1000 * (travels_m - travels_m[np.argmax(np.array(forces_n) > 0)])  # from the first contact
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    axes.plot(depths_mm, forces_n, "o-", markersize=4)
    axes.set(xlabel="depth [mm]", ylabel="force [N]", title="A probe of 12 mm radius in the demo liver")
    axes.grid(alpha=0.3)
    figure.savefig(file, dpi=150)
    for depth_mm, force_n in zip(depths_mm[::3], forces_n[::3], strict=True):
        print(f"{depth_mm:6.1f} mm {force_n:7.3f} N")
    print(f"wrote {file}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "force_depth.png")
