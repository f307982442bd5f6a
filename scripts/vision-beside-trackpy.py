#!/usr/bin/env python3
"""cellpos vision compared with trackpy on the same frames: recall, error and time.

    pip install trackpy pillow tifffile
    scripts/vision-beside-trackpy.py [--cellpos PROGRAM] [--data ../shared/data]

Without --cellpos the program is built in release first. Times are medians over the frames, of one frame and in one thread.

Rendered frames have a truth: the profile of a bead in bright field, places drawn evenly, normal noise. On the measured
beads and on the trapped one there is none: there the error is the RMS distance from another track that comes with the
data, constant offsets taken off: a radial template fit (0.02 to 0.04 px from other methods), the authors' circle fit (whose
own noise is 0.27 px).
"""
import argparse
import csv
import json
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


def spots(frames=20, size=512, count=600, sigma=1.5, snr=20):
    """Frames of Gaussian spots in a grid, each moved by up to 4 px, and their places."""
    rng = np.random.default_rng(2)
    side = int(np.ceil(np.sqrt(count)))
    pitch = size / side
    pictures, truth = [], []
    for _ in range(frames):
        grey = np.full((size, size), 60.0)
        places = []
        for k in range(count):
            px, py = pitch * (np.array([k % side, k // side]) + 0.5) + rng.uniform(-4, 4, 2) - 0.5
            i, j = int(px) - 8, int(py) - 8
            x, y = np.meshgrid(np.arange(max(i, 0), min(i + 17, size)), np.arange(max(j, 0), min(j + 17, size)))
            grey[y, x] += 100 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * sigma**2))
            places.append((px, py))
        grey += 100 / snr * rng.standard_normal(grey.shape)
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


def beside(tracks, found):
    """Recall, and the RMS distance from others' tracks (one array of places a bead), each track's constant offset taken off."""
    count, off = 0, []
    for track in tracks:
        own = []
        for (px, py), seen in zip(track, found):
            near = min(seen, key=lambda s: np.hypot(s[0] - px, s[1] - py), default=None)
            if near is not None and np.hypot(near[0] - px, near[1] - py) < 6:
                own.append((near[0] - px, near[1] - py))
        count += len(own)
        if own:
            off += list((np.array(own) - np.mean(own, axis=0)).ravel())
    extra = sum(map(len, found)) - count
    return count / sum(map(len, tracks)), float(np.sqrt(np.mean(np.square(off)))) if off else float("nan"), extra


def template_fits(path):
    """Tracks of the five measured beads by a radial template fit."""
    tracks = {}
    with open(path) as file:
        for row in csv.DictReader(file):
            tracks.setdefault(row["particle"], []).append((float(row["x_tm"]), float(row["y_tm"])))
    return [np.array(track) for track in tracks.values()]


def release():
    """The program, built in release; cargo names its place."""
    root = pathlib.Path(__file__).resolve().parent.parent
    built = subprocess.run(
        ["cargo", "build", "--release", "-p", "cellpos", "--bin", "cellpos", "--message-format", "json-render-diagnostics"],
        cwd=root, stdout=subprocess.PIPE, text=True, check=True)
    for line in built.stdout.splitlines():
        message = json.loads(line)
        if message.get("executable") and message["target"]["name"] == "cellpos":
            return message["executable"]
    raise SystemExit("cargo names no program")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cellpos", help="program to measure; left out: built in release from this tree")
    parser.add_argument("--data", default="../shared/data")
    args = parser.parse_args()
    if args.cellpos is None:
        args.cellpos = release()
    print("| frames | program | recall | error px | others found | median ms a frame |\n|---|---|---|---|---|---|")
    for snr in (10, 40):
        pictures, truth = rendered(snr)
        for name, (found, ms) in (
            ("cellpos vision", by_cellpos(args.cellpos, pictures)),
            ("trackpy 21 px", by_trackpy(pictures, 21, 2000, False)),
        ):
            recall, error, extra = against(truth, found)
            print(f"| rendered, SNR {snr} | {name} | {recall:.3f} | {error:.4f} | {extra} | {ms:.2f} |")
    pictures, truth = spots()
    for name, (found, ms) in (
        ("cellpos vision", by_cellpos(args.cellpos, pictures)),
        ("trackpy 9 px", by_trackpy(pictures, 9, 400, False)),
    ):
        recall, error, extra = against(truth, found)
        print(f"| 600 spots of 1.5 px, SNR 20 | {name} | {recall:.3f} | {error:.4f} | {extra} | {ms:.2f} |")
    data = pathlib.Path(args.data)
    for label, name, tracks, diameter, minmass, invert in (
        ("beads-brightfield", "beads-brightfield", lambda f: template_fits(f / "reference.csv"), 21, 2000, False),
        # Of diameters from 31 to 81 px this one gives trackpy the smallest error.
        ("trapped-bead", "trapped-bead/frames",
         lambda f: [np.loadtxt(f.parent / "authors-track.txt", skiprows=1)[:, 1:3]], 81, 20000, True),
    ):
        folder = data / name
        if not folder.exists():
            print(f"| {label} | not there: {folder} | | | | |")
            continue
        pictures = read(folder)
        for name, (found, ms) in (
            ("cellpos vision", by_cellpos(args.cellpos, pictures)),
            (f"trackpy {diameter} px", by_trackpy(pictures, diameter, minmass, invert)),
        ):
            recall, error, extra = beside(tracks(folder), found)
            print(f"| {label} | {name} | {recall:.3f} | {error:.4f} | {extra} | {ms:.2f} |")


if __name__ == "__main__":
    main()
