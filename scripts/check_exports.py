#!/usr/bin/env python3
"""Compare the exports of a run as other programs read them: pandas (CSV, Parquet), h5py (HDF5), SciPy (MAT).

    cellpos export RUN --out t.csv; cellpos export RUN --out t.parquet
    cellpos export RUN --out t.h5;  cellpos export RUN --out t.mat
    pip install pandas pyarrow h5py scipy
    scripts/check_exports.py t

Exit code 1: two exports differ, or one cannot be read.
"""

import sys

import h5py
import numpy as np
import pandas as pd
import scipy.io


def words(codes) -> dict:
    """`0 good, 1 no-signal` as {0: "good", 1: "no-signal"}; h5py gives a text of fixed length as bytes."""
    codes = codes.decode() if isinstance(codes, bytes) else codes
    pairs = (part.split(" ", 1) for part in codes.split(", "))
    return {int(number): word for number, word in pairs}


def main(stem: str) -> int:
    csv = pd.read_csv(f"{stem}.csv")
    parquet = pd.read_parquet(f"{stem}.parquet")
    mat = scipy.io.loadmat(f"{stem}.mat")
    wrong = []
    with h5py.File(f"{stem}.h5") as hdf5:
        ticks = hdf5["ticks"]
        if set(ticks) != set(csv.columns) or list(parquet.columns) != list(csv.columns):
            wrong.append("the columns differ")
        for name in csv.columns:
            dataset = ticks[name]
            if dataset.shape != (len(csv),):
                wrong.append(f"{name}: {dataset.shape} rows in HDF5, {len(csv)} in CSV")
                continue
            if "codes" in dataset.attrs:
                known = words(dataset.attrs["codes"])
                text = csv[name].astype(object).where(csv[name].notna(), None)
                from_hdf5 = [known.get(int(value)) for value in dataset[:]]
                from_mat = [None if np.isnan(v) else known.get(int(v)) for v in mat[name].ravel()]
                from_parquet = parquet[name].astype(object).where(parquet[name].notna(), None)
                same = list(text) == from_hdf5 == from_mat == list(from_parquet)
            else:
                expected = csv[name].to_numpy(dtype=float)
                others = (dataset[:], mat[name].ravel(), parquet[name])
                same = all(
                    np.array_equal(np.asarray(other, dtype=float), expected, equal_nan=True)
                    for other in others
                )
            if not same:
                wrong.append(f"{name}: the values differ")
        print(f"{len(csv)} rows, {len(csv.columns)} columns; cycles: {list(hdf5['cycles'])[:3]}; "
              f"events: {len(hdf5['events/event']) if 'event' in hdf5['events'] else 0}")
    print("\n".join(wrong) if wrong else "equal in CSV, Parquet, HDF5 and MAT")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
