"""The emulated rig with a pressure controller in the PZT's place: commands every 20 ms, a regulator of 50 ms, a tube that stretches."""

import pytest
from conftest import ROOT

import cellpos

INTEGRATOR = """name = "integrator"
working_point_um = 20.0
[plant]
num = [428.0]
den = [1.0, 0.0]
[noise]
diffusion_um2_per_s = 0.33
localisation_um = 0.03
"""


@pytest.fixture
def rigs(tmp_path):
    pressure = '[actuator]\nkind = "emulated-pressure"\n'
    (tmp_path / "pressure.toml").write_text(pressure)
    (tmp_path / "integrator.toml").write_text(INTEGRATOR)
    own = '[emulator]\nmodel = "integrator.toml"\n'
    (tmp_path / "regulator.toml").write_text(pressure + own)
    (tmp_path / "tube.toml").write_text(pressure + 'regulator = "50ms"\ncompliance = "20ms"\n' + own)
    return tmp_path


def held(folder, rig, law, model="eq6", **more):
    options = {"rig": rig, "controller": law, "model": model, "clock": "virtual", "frames": "off", "adapt": "off"} | more
    duration = options.pop("duration", "120s")
    result = cellpos.track("0um", duration, cwd=folder, no_record=True, **options).result
    assert result.ended == "done" and result["ticks"] == 50 * int(duration[:-1])
    return result["rms_true_nm"], result["bound_rms_nm"]


def test_a_bead_is_held_at_20_ms_a_command(rigs):
    pi, bound = held(rigs, "pressure.toml", "pi")
    lqg, _ = held(rigs, "pressure.toml", "lqg")
    mpc, _ = held(rigs, "pressure.toml", "mpc")
    with_tube, bound_with_tube = held(rigs, "tube.toml", "lqg", "integrator.toml")
    print(f"PI {pi:.0f} nm, LQG {lqg:.0f} nm, MPC {mpc:.0f} nm, bound {bound:.0f} nm; with a tube of 20 ms {with_tube:.0f} of {bound_with_tube:.0f} nm")
    assert bound < lqg < 1.15 * bound and mpc < 1.15 * bound
    assert lqg < 0.9 * pi < 240
    assert bound_with_tube < with_tube < 1.15 * bound_with_tube


def test_a_loop_that_adapts_holds_behind_regulator_and_tube(rigs):
    # An inverse of this path, with its zero outside the unit circle, grows by 2.7 a tick: seeds 4 to 6 lost the bead. A pulse of one tick
    # armed seeds 7 and 12 with 1.3 and 1.5 of the gain: the second lost the bead.
    over = []
    for seed in (4, 5, 6, 7, 11, 12):
        nm, bound = held(rigs, "tube.toml", "lqg", "integrator.toml", adapt="on", seed=seed, duration="240s")
        over.append(nm / bound)
    print("of the bound:", *(f"{one:.3f}" for one in over))
    # An RMS of 12000 ticks has a standard deviation of 1 %: half of its terms are independent.
    assert sum(over) / len(over) < 1.15 and max(over) < 1.15 * 1.03


def test_identify_finds_the_regulator(rigs):
    options = {"rig": "regulator.toml", "model": "integrator.toml", "frames": "off", "led_edges": 0, "out": "m.toml"}
    result = cellpos.identify(seed=1, cwd=rigs, **options).result
    assert [line["frequency_hz"] for line in result["frequencies"]][-1] == 14.0
    parameters = result["parameters"]
    for name, truth in (("gain_per_s", 428.0), ("pair_pole_rad_per_s", 20.0)):
        low, high = parameters[name]["ci95"]
        assert low <= truth <= high and high - low < 0.05 * truth, (name, parameters[name])


def test_a_script_is_checked_rehearsed_and_run(rigs):
    staircase = ROOT / "examples/scripts/staircase.toml"
    rehearsed = cellpos.run(staircase, rig="pressure.toml", dry=True, controller="lqg", cwd=rigs).result
    assert rehearsed["cycles_done"] == 60
    # Ticks of 20 ms: the rehearsal is on the slow actuator, too.
    assert rehearsed.run.summary["ticks"] < 1000
    result = cellpos.run(staircase, rig="pressure.toml", controller="lqg", clock="virtual", frames="off", cwd=rigs).result
    assert result["cycles_done"] == 60 and result["cycle_rms_nm"] < 300


def test_design_counts_the_lags_of_the_rig_file(rigs):
    def gains(rig):
        return cellpos.command("design", model="eq6", rig=rig, controller="pi", out="c.toml", force=True, cwd=rigs).result

    (rigs / "pzt.toml").write_text("[timing]\nperiod_us = 20000.0\n")
    slow, fast = gains("pressure.toml"), gains("pzt.toml")
    assert slow["controller"]["kp_um_per_um"] < 0.5 * fast["controller"]["kp_um_per_um"]


@pytest.mark.parametrize(
    "text, said",
    [
        ("regulator_ms = -1.0", "regulator_ms = -1: must be 0 to 10000 ms"),
        ("period_ms = 0.5", "period_ms = 0.5: must be 1 to 1000 ms"),
    ],
)
def test_values_that_cannot_be_are_named(rigs, text, said):
    (rigs / "wrong.toml").write_text(f'[actuator]\nkind = "emulated-pressure"\n{text}\n')
    with pytest.raises(cellpos.Failed, match=said):
        cellpos.track("0um", rig="wrong.toml", cwd=rigs).wait()


def test_identify_finds_the_regulator_and_the_tube(rigs):
    options = {"rig": "tube.toml", "model": "integrator.toml", "frames": "off", "led_edges": 0, "out": "m.toml"}
    result = cellpos.identify(seed=1, cwd=rigs, **options).result
    assert result["model_formula"] == "K/(s (1 + s/p)(1 + s/r)) e^(-sL)"
    parameters = result["parameters"]
    for name, truth in (("gain_per_s", 428.0), ("pair_pole_rad_per_s", 20.0), ("second_pole_rad_per_s", 50.0)):
        low, high = parameters[name]["ci95"]
        assert low <= truth <= high and high - low < 0.2 * truth, (name, parameters[name])
    # The plant that was found holds the bead as the one that was told does.
    told, _ = held(rigs, "tube.toml", "lqg", "integrator.toml")
    found, _ = held(rigs, "tube.toml", "lqg", "m.toml")
    assert found < 1.05 * told, (found, told)
