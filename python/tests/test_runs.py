"""A run opened by the module is the run that the program exports."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, started

import cellpos
from cellpos._columns import FLAGS, ORDER, WORDS


def exported(folder: Path, run: str):
    started(folder, "export", run, "--out", "whole.csv", "--force")
    with (folder / "whole.csv").open() as file:
        rows = list(csv.reader(file))
    return {name: column for name, column in zip(rows[0], zip(*rows[1:]))}


@pytest.mark.parametrize("name", ["latest-hold", "latest-long"])
def test_every_column_of_an_export_has_the_same_values(here, name):
    run, columns = cellpos.open(name), exported(here, name)
    assert set(run.ticks) - {"error_um"} <= set(columns)
    for column, texts in columns.items():
        if column not in run.ticks:
            # The export has every column that a run can have; this run has nothing in it.
            assert len(set(texts)) == 1, column
            continue
        mine = run.ticks[column]
        if column in WORDS:
            assert [word or "" for word in mine] == list(texts), column
        else:
            theirs = np.array([float(text) if text else np.nan for text in texts])
            np.testing.assert_allclose(mine.astype(float), theirs, rtol=1e-12, atol=0, err_msg=column)


def test_the_columns_words_and_flags_are_those_of_the_page_on_data():
    page = (ROOT / "docs/data.md").read_text()
    table = page.split("### Ticks")[1].split("The control law's columns")[0]
    names = [line.split("`")[1] for line in table.splitlines() if line.startswith("| `")]
    assert list(ORDER) == names
    words = page.split("Words and their numbers")[1].split("The bits of")[0]
    for line in words.splitlines():
        if line.startswith("| `"):
            parts = line.split("`")
            numbers = {int(parts[i].strip(" |,")): parts[i + 1] for i in range(2, len(parts) - 1, 2)}
            assert WORDS[parts[1]] == numbers, parts[1]
    bits = page.split("The bits of `flags`")[1].split("## Reading it elsewhere")[0]
    named = [line.split("|")[1:3] for line in bits.splitlines() if line[:3].strip("| ").isdigit() or line.startswith("| 1")]
    assert {name.strip(): int(value) for value, name in named} == FLAGS


def test_the_error_is_of_the_exposure_and_its_rms_is_the_programs(here):
    run = cellpos.open("latest-hold")
    assert run.rms_nm == pytest.approx(run.summary["rms_measured_nm"], rel=1e-9)
    ticks = cellpos.open("latest-long").ticks
    held = ticks["life"] == "running"
    # On a sine, the error against the reference of the tick is larger: the exposure is 2 ms old.
    at_tick = ticks["bead_um"] - ticks["target_um"]
    assert np.nanstd(ticks["error_um"][held]) < 0.8 * np.nanstd(at_tick[held])


def test_sessions_are_joined_on_one_axis(here):
    run = cellpos.open("latest-long")
    assert [session.number for session in run.sessions] == [1, 2]
    assert np.all(np.diff(run.ticks["time_s"]) > 0)
    assert set(run.ticks["session"]) == {1, 2}
    assert list(run.cycles["cycle"]) == list(range(1200))
    assert set(run.cycles["session"]) == {1, 2}
    assert np.all(np.diff(run.events["time_s"][run.events["session"] == 2]) >= 0)
    first_of_second = run.ticks["time_s"][run.ticks["session"] == 2][0]
    assert run.events["time_s"][run.events["session"] == 2][0] >= first_of_second - 1.0


def test_runs_are_a_table(here):
    table = cellpos.runs("runs")
    assert list(table["name"]) == ["hold", "long"]
    assert table["outcome"][0] == "done" and table["sessions"][1] == 2
    assert table["rms_true_nm"][0] > 0


def test_columns_are_read_when_they_are_asked_for(here):
    run = cellpos.open("latest-hold")
    assert run.ticks._kept == {}
    run.ticks["bead_um"]
    assert set(run.ticks._kept) == {"bead_um"}
    with pytest.raises(KeyError, match="no column 'bead'; there are: time_s"):
        run.ticks["bead"]


def copied(here, tmp_path) -> Path:
    """A session of many batches that came to its end."""
    target = tmp_path / "copy"
    shutil.copytree(cellpos.open("latest-long").sessions[1].folder, target)
    return target


def test_a_file_that_was_cut_off_gives_the_rows_before(here, tmp_path):
    folder = copied(here, tmp_path)
    whole = cellpos.Run(shutil.copytree(folder, tmp_path / "whole"))
    arrow = folder / "ticks.arrow"
    last = whole.sessions[0].stream.batches[-1]
    arrow.write_bytes(arrow.read_bytes()[: last.body + 100])
    cut = cellpos.open(folder)
    assert cut.ticks.rows == whole.ticks.rows - last.rows
    np.testing.assert_array_equal(cut.ticks["seq"], whole.ticks["seq"][: cut.ticks.rows])


def test_a_damaged_row_and_a_block_of_zeros_are_left_out_and_counted(here, tmp_path):
    folder = copied(here, tmp_path)
    whole = cellpos.Run(shutil.copytree(folder, tmp_path / "whole"))
    arrow = folder / "ticks.arrow"
    data = bytearray(arrow.read_bytes())
    batches = whole.sessions[0].stream.batches
    # One bit of one value of the second batch, and the whole of the third with its head.
    data[batches[1].body + int(batches[1].offsets[0]) + 8 * 5] ^= 1
    end = batches[2].body + int(batches[2].offsets[-1])
    behind = batches[1].body + int(batches[1].offsets[-1]) + 4 * batches[1].rows
    behind += -behind % 64
    data[behind:end] = bytes(end - behind)
    arrow.write_bytes(bytes(data))
    run = cellpos.open(folder)
    assert run.ticks.rows == whole.ticks.rows - batches[2].rows - 1
    assert run.lost["damaged_rows"] == 1 and run.lost["damaged_bytes"] > 0
    assert run.lost["rows"] == batches[2].rows + 1
    kept = np.isin(whole.ticks["seq"], run.ticks["seq"])
    np.testing.assert_array_equal(run.ticks["bead_um"], whole.ticks["bead_um"][kept])


def test_every_prefix_of_a_file_opens(here, tmp_path):
    folder = copied(here, tmp_path)
    data = (folder / "ticks.arrow").read_bytes()
    rng = np.random.default_rng(1)
    for length in rng.integers(0, len(data), 20):
        (folder / "ticks.arrow").write_bytes(data[:length])
        run = cellpos.open(folder)
        assert run.ticks.rows * 100 <= length


def test_random_damage_never_raises(here, tmp_path):
    folder = copied(here, tmp_path)
    clean = (folder / "ticks.arrow").read_bytes()
    rng = np.random.default_rng(2)
    most = cellpos.open(folder).ticks.rows
    for _ in range(15):
        data = bytearray(clean)
        for place in rng.integers(1200, len(data), 20):
            data[place] = rng.integers(256)
        (folder / "ticks.arrow").write_bytes(bytes(data))
        assert cellpos.open(folder).ticks.rows <= most


def test_a_newer_format_is_refused_with_what_to_do(here, tmp_path):
    folder = copied(here, tmp_path)
    text = (folder / "run.toml").read_text().replace("format = 2", "format = 3")
    (folder / "run.toml").write_text(text)
    with pytest.raises(ValueError, match="format 3.*update"):
        cellpos.open(folder)


def test_what_is_not_there_is_named(here):
    with pytest.raises(FileNotFoundError, match="holds no run named nothing"):
        cellpos.open("latest-nothing")
    with pytest.raises(FileNotFoundError, match="no ticks.arrow"):
        cellpos.open(".")


def test_clips_are_pictures_with_times(tmp_path):
    from cellpos import Clip

    # As the program writes it: little-endian, one strip, not compressed.
    import struct

    frames = np.arange(2 * 3 * 4, dtype="<u2").reshape(2, 3, 4)
    data, link = bytearray(b"II*\0\0\0\0\0"), 4
    for page in frames:
        place = len(data)
        data += page.tobytes()
        tags = [(256, 4, 1, 4), (257, 4, 1, 3), (258, 3, 1, 16), (259, 3, 1, 1), (273, 4, 1, place), (279, 4, 1, 24)]
        struct.pack_into("<I", data, link, len(data))
        data += struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags)
        link = len(data)
        data += bytes(4)
    (tmp_path / "cycle-1.tif").write_bytes(bytes(data))
    (tmp_path / "cycle-1.csv").write_text("frame,time_s,frame_id\n0,1.5,7\n1,1.501,8\n")
    clip = Clip(tmp_path / "cycle-1.tif", offset_s=10.0)
    np.testing.assert_array_equal(clip.frames, frames)
    np.testing.assert_allclose(clip.times["time_s"], [11.5, 11.501])


def test_a_clip_of_a_real_run_opens(here, tmp_path):
    script = 'name = "clip"\n[clips]\ncycles = [1, 3]\nbefore = "50ms"\nafter = "50ms"\n[[step]]\ndo = "sine"\n'
    (tmp_path / "clip.toml").write_text(script + 'amplitude = "1um"\nfrequency = "5Hz"\ncycles = 5\n')
    # A machine that others use is late for longer than a rig may be.
    (tmp_path / "rig.toml").write_text("first_neutral_um = 20.0\n[timing]\nfaults_in_a_row = 100000\n")
    result = cellpos.run("clip.toml", rig="rig.toml", cwd=tmp_path).result
    assert result.ended == "reference-over"
    clips = result.run.clips
    assert len(clips) >= 2, clips
    clip = next(iter(clips.values()))
    assert len(clip.frames) == len(clip.times["time_s"]) > 20
    assert clip.frames.ndim == 3 and clip.frames.std() > 1
