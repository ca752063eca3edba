# SPDX-License-Identifier: GPL-3.0-or-later
"""Take most seed points of far surfaces out of a synthetic capture: structure from motion finds few out there.

    .venv/bin/python benchmarks/thin_seeds.py CAPTURE --beyond 20 --keep 30

Far is what lies more than `--beyond` units from the middle of the cameras; `--keep` such points are left in each frame.
Points near by stay. The same points are kept however often it is run.
"""

import argparse
from pathlib import Path

import numpy as np
from holoreel.core.capture import Points, read_capture, write_points


def main() -> None:
    """Thin the seed points of all frames, in place."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--beyond", type=float, required=True)
    parser.add_argument("--keep", type=int, default=30)
    arguments = parser.parse_args()
    capture = read_capture(arguments.capture)
    middle = np.mean([camera.center for camera in capture.cameras.values()], axis=0)
    for frame, path in capture.seeds.items():
        points = capture.seed_points(frame)
        is_far = np.linalg.norm(points.xyz - middle, axis=1) > arguments.beyond
        far = np.flatnonzero(is_far)
        if len(far) > arguments.keep:
            far = np.random.default_rng(frame).choice(far, arguments.keep, replace=False)
        kept = np.sort(np.concatenate([np.flatnonzero(~is_far), far]))
        write_points(path, Points(points.xyz[kept], points.rgb[kept]))
        print(f"{path.name}: {len(kept)} of {len(points.xyz)} points")


if __name__ == "__main__":
    main()
