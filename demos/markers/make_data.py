"""Synthetic markers of `gel.toml`: a finer mesh, cubic elements and smaller steps than any fit of the tutorial has."""

from pathlib import Path

import numpy as np

import softgrasp as sg

FOLDER = Path(__file__).parent
NOISE = 1e-4  # [m], of a camera
TRUTH = {"lambda": 45e3, "mu": 4.2e3, "rho": 1000.0}  # the tutorial reveals it at its end
BETA = 3.1e-3  # [s]
FINER = ["tissue.order=3", "tissue.refine.tolerance=5e-4", "time.steps=3200", "output.snapshots='none'"]


def main() -> None:
    """Write markers.csv: time and two markers at 200 Hz, some samples missing."""
    damping = {"kind": "kelvin-voigt", "beta": BETA}
    model = sg.build(FOLDER / "gel.toml", FINER, tissue={"material": TRUTH}, effects={"damping": damping})
    run = sg.simulate(model)
    rng = np.random.default_rng(2024)
    y = run.outputs[::16] + rng.normal(0, NOISE, run.outputs[::16].shape)
    y[rng.random(y.shape) < 0.02] = np.nan
    lines = ["time [s]," + ",".join(f"{name} [m]" for name in run.output_names)]
    for t, row in zip(run.times[::16], y, strict=True):
        lines.append(",".join([f"{t:.4f}", *("" if np.isnan(x) else f"{x:.6f}" for x in row)]))
    Path("markers.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
