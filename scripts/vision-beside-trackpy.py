#!/usr/bin/env python3
"""cellpos vision beside trackpy on the same frames: recall, error and time.

    pip install trackpy pillow tifffile
    scripts/vision-beside-trackpy.py [--cellpos target/release/cellpos] [--data ../shared/data]

Rendered frames have a truth: the profile of a bead in bright field, places drawn evenly, normal noise. On the measured
beads and on the trapped one there is none: there the error is the localisation noise out of the covariance of successive
steps (an error enters two of them with opposite signs); "hidden" where diffusion hides it.
"""
import argparse
import csv
import pathlib
import subprocess
import tempfile
import time
import warnings

import numpy as np
import trackpy
from PIL import Image

warnings.filterwarnings("ignore")
trackpy.quiet()
KNOTS = np.array(
    [1.0, 1.0035, 1.011, 1.0185, 1.015, 0.9755, 0.8838, 0.7338, 0.5443, 0.2905, 0.0, -0.2799, -0.4644, -0.5395,
     -0.5241, -0.4298, -0.276, -0.1124, -0.0044, 0.03, 0.0167, -0.0025, -0.011, -0.0071, -0.0017, 0.0, 0.0])


def rendered(snr, frames=60, size=200, edge=6.4):
    """Frames of five beads each, and their places."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    pictures, truth = [], []
    for _ in range(frames):
        grey = np.full((size, size), 120.0)
        places = [(40 + 60 * (k % 3) + rng.uniform(-8, 8), 50 + 80 * (k // 3) + rng.uniform(-8, 8)) for k in range(5)]
        for px, py in places:
            grey += 80 * np.interp(np.hypot(x - px, y - py), edge / 10 * np.arange(len(KNOTS)), KNOTS)
        grey += 80 / snr * rng.standard_normal(grey.shape)
        pictures.append(np.clip(np.round(grey), 0, 255).astype(np.uint8))
        truth.append(places)
    return pictures, truth


def read(folder):
    paths = sorted(p for p in pathlib.Path(folder).iterdir() if p.suffix in (".png", ".tif"))
    pictures = [np.asarray(Image.open(p)) for p in paths]
    return [p if p.ndim == 2 else p[..., 0] for p in pictures]


def by_cellpos(program, pictures):
    with tempfile.TemporaryDirectory() as root:
        frames = pathlib.Path(root, "frames")
        frames.mkdir()
        for n, picture in enumerate(pictures):
            Image.fromarray(picture).save(frames / f"f_{n:04}.png")
        out = pathlib.Path(root, "out")
        run = subprocess.run([program, "vision", str(frames), "--out", str(out), "--json"], capture_output=True, text=True)
        if not (out / "positions.csv").exists():
            return [[] for _ in pictures], float("nan")
        found = [[] for _ in pictures]
        with open(out / "positions.csv") as file:
            for row in csv.DictReader(file):
                if row["verdict"] == "good":
                    found[int(row["frame"])].append((float(row["x_px"]), float(row["y_px"])))
        import json
        return found, json.loads(run.stdout)["time_us"]["p50"] / 1000


def by_trackpy(pictures, diameter, minmass, invert):
    found, times = [], []
    for picture in pictures:
        start = time.perf_counter()
        table = trackpy.locate(picture, diameter, minmass=minmass, invert=invert)
        times.append(time.perf_counter() - start)
        found.append(list(zip(table.x, table.y)))
    return found, 1000 * float(np.median(times))


def against(truth, found):
    errors, count = [], 0
    for places, seen in zip(truth, found):
        count += len(places)
        for px, py in places:
            near = min(seen, key=lambda s: np.hypot(s[0] - px, s[1] - py), default=None)
            if near is not None and np.hypot(near[0] - px, near[1] - py) < 2:
                errors += [near[0] - px, near[1] - py]
    extra = sum(map(len, found)) - len(errors) // 2
    return len(errors) / 2 / count, float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan"), extra


def noise(found, beads):
    """Recall, and the localisation noise out of the covariance of successive steps."""
    tracks = [[p] for p in found[0]]
    for seen in found[1:]:
        for track in tracks:
            if track[-1] is not None and seen:
                near = min(seen, key=lambda s: np.hypot(s[0] - track[-1][0], s[1] - track[-1][1]))
                track.append(near if np.hypot(near[0] - track[-1][0], near[1] - track[-1][1]) < 12 else None)
    products = []
    for track in tracks:
        steps = np.diff(np.array([p for p in track if p is not None]), axis=0)
        steps = steps - steps.mean(axis=0)
        products += list((steps[1:] * steps[:-1]).ravel())
    recall = sum(min(len(s), beads) for s in found) / beads / len(found)
    mean, sd = np.mean(products), np.std(products) / np.sqrt(len(products))
    return recall, f"{np.sqrt(-mean):.4f}" if -mean > 2 * sd else "hidden", sum(max(0, len(s) - beads) for s in found)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cellpos", default="target/release/cellpos")
    parser.add_argument("--data", default="../shared/data")
    args = parser.parse_args()
    print("| frames | program | recall | error px | others found | ms a frame |\n|---|---|---|---|---|---|")
    for snr in (10, 40):
        pictures, truth = rendered(snr)
        for name, (found, ms) in (
            ("cellpos vision", by_cellpos(args.cellpos, pictures)),
            ("trackpy 21 px", by_trackpy(pictures, 21, 2000, False)),
        ):
            recall, error, extra = against(truth, found)
            print(f"| rendered, SNR {snr} | {name} | {recall:.3f} | {error:.4f} | {extra} | {ms:.2f} |")
    data = pathlib.Path(args.data)
    for label, folder, beads, diameter, minmass, invert in (
        ("beads-brightfield", data / "beads-brightfield", 5, 21, 2000, False),
        ("trapped-bead", data / "trapped-bead/frames", 1, 61, 20000, True),
    ):
        if not folder.exists():
            print(f"| {label} | not there: {folder} | | | | |")
            continue
        pictures = read(folder)
        for name, (found, ms) in (
            ("cellpos vision", by_cellpos(args.cellpos, pictures)),
            (f"trackpy {diameter} px", by_trackpy(pictures, diameter, minmass, invert)),
        ):
            recall, error, extra = noise(found, beads)
            print(f"| {label} | {name} | {recall:.3f} | {error} | {extra} | {ms:.2f} |")


if __name__ == "__main__":
    main()
