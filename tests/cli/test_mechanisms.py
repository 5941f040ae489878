"""Commands about a mechanism, compared with the results of the functions, as JSON and as files."""

import csv
import json
import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray

from tests.command_line import udkjax
from udkjax.cli.datasets import save
from udkjax.cli.exits import exit_codes
from udkjax.positions.assembling.assembly import AssemblyWarning

EXAMPLES = Path(__file__).parents[2] / "examples"


def results(capsys, *arguments):
    assert udkjax(*arguments, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_kinematics(tmp_path, capsys):
    out = tmp_path / "k.nc"
    scene = EXAMPLES / "slider_crank.toml"
    found = results(capsys, "kinematics", scene, "--driver", "motor", "--from", 0.0, "--to", 6.0, "--count", 7, "--out", out)
    assert found["status"] == ["closed"] * 7
    assert found["travel"] == [None, None]
    s, x = np.array(found["values"]), np.array(found["q"])[:, 2, 0]
    np.testing.assert_allclose(x, 0.5 * np.cos(s) + np.sqrt(1.5**2 - 0.25 * np.sin(s) ** 2), atol=1e-12)
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        np.testing.assert_allclose(data.q.sel(body="slider", coordinate="x"), x)
        assert data.attrs["scene"] == scene.read_text()


@pytest.mark.slow
def test_velocities_are_those_of_the_motor_s_own_speed(tmp_path, capsys):
    """Example 6-7 of Norton, "Design of machinery": links of 100, 40, 120 and 80 mm, the crank at 40 deg and 25 rad/s."""
    angle, place = math.radians(40.0), complex(0.1, 0.0)
    crank = 0.04 * complex(math.cos(angle), math.sin(angle))
    along = (crank - place) / abs(crank - place)
    side = (0.08**2 + abs(crank - place) ** 2 - 0.12**2) / (2 * abs(crank - place))
    pin = place + along * complex(side, -math.sqrt(0.08**2 - side**2))
    scene = tmp_path / "norton.toml"
    pins = {"O": 0j, "A": crank, "B": pin, "C": place}
    links = {"crank": "OA", "coupler": "AB", "rocker": "CB"}
    scene.write_text(
        'format = 2\nground = ["O", "C"]\nmotor = [{pin = "O", speed = "25 rad/s"}]\n[pins]\n'
        + "".join(f"{name} = [{z.real!r}, {z.imag!r}]\n" for name, z in pins.items())
        + "".join(f'[[link]]\nname = "{name}"\npins = {list(ends)}\nmass = 1\n' for name, ends in links.items())
    )
    v = np.array(results(capsys, "kinematics", scene, "--count", 1)["v"])[0, :, 2]
    np.testing.assert_allclose(v, [25.0, -4.121, 6.998], atol=1e-3)
    slow = np.array(results(capsys, "kinematics", scene, "--count", 1, "--rate", 1.0)["v"])[0, :, 2]
    np.testing.assert_allclose(slow, v / 25.0, rtol=1e-12)
    assert udkjax("kinematics", scene, "--out", tmp_path / "k.csv") == 0
    assert "velocities at 25 rad/s (238.732 rpm) of motor1" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("driver", "problem"), [("motr", 'did you mean "motor"'), ("body.slider.x", 'body.slider.x is held by driver "motor"')]
)
def test_kinematics_refuses_what_cannot_be_driven(capsys, driver, problem):
    assert udkjax("kinematics", EXAMPLES / "slider_crank.toml", "--driver", driver) == 2
    assert problem in capsys.readouterr().err


def test_inverse(tmp_path, capsys):
    out = tmp_path / "i.nc"
    found = results(capsys, "inverse", EXAMPLES / "slider_crank.toml", "--t1", 0.3, "--dt", 0.1, "--out", out)
    torque, power = np.array(found["efforts"]["motor"]), np.array(found["powers"]["motor"])
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        np.testing.assert_allclose(data.effort.sel(driver="motor"), torque)
        save(data, tmp_path / "i.csv")
    heading, *lines = (tmp_path / "i.csv").read_text().splitlines()
    assert heading == "time,effort.motor [N m],power.motor [W]"
    np.testing.assert_array_equal([float(line.split(",")[1]) for line in lines], torque)
    rate = power[0] / torque[0]
    np.testing.assert_allclose(power, rate * torque)
    peak = found["peaks"]["motor"]
    assert abs(peak["effort"]) == pytest.approx(np.max(np.abs(torque)))
    work = np.array([0.0, *np.cumsum(0.05 * (power[1:] + power[:-1]))])
    assert peak["work"] == pytest.approx(work[-1])
    assert peak["swing"] == pytest.approx(np.ptp(work - np.linspace(0.0, work[-1], 4)))
    assert udkjax("inverse", EXAMPLES / "parallelogram.toml", "--t1", 0.3) == 2


def test_a_scene_that_finds_no_rest_says_so(tmp_path, capsys):
    scene = tmp_path / "fall.toml"
    scene.write_text('format = 1\n[[body]]\nname = "stone"\nmass = 1.0\ninertia = 0.1\n')
    assert udkjax("statics", scene) == 1
    assert "no equilibrium was found" in capsys.readouterr().err


def test_statics_and_modes_of_a_scene_without_a_degree_of_freedom(capsys):
    for command in ("statics", "modes"):
        assert udkjax(command, EXAMPLES / "slider_crank.toml") == 0
        assert "no degree of freedom is left" in capsys.readouterr().out


def test_statics_and_modes_of_the_papers_linkage(tmp_path, capsys):
    rest = results(capsys, "statics", EXAMPLES / "parallelogram.toml", "--stable", "--out", tmp_path / "s.nc")["equilibria"]
    assert rest[0]["stable"]
    np.testing.assert_allclose(rest[0]["omega2"], [3.5 * 9.81 / 3.05], rtol=1e-9)
    found = results(capsys, "modes", EXAMPLES / "parallelogram.toml", "--out", tmp_path / "m.nc")
    np.testing.assert_allclose(found["frequencies"], [np.sqrt(3.5 * 9.81 / 3.05)], rtol=1e-9)
    with xarray.open_dataset(tmp_path / "m.nc", engine="h5netcdf") as data:
        assert data["shape"].dims == ("mode", "body", "coordinate")
        np.testing.assert_allclose(data["shape"], found["shapes"])
        save(data, tmp_path / "m.csv")  # a position has no mode: each row repeats it
    (row,) = csv.DictReader((tmp_path / "m.csv").open())
    assert float(row["omega2 [1/s2]"]) == found["omega2"][0]
    assert float(row["body.link2.x [m]"]) == found["q"][found["bodies"].index("link2")][0]


CLAMP = """
format = 2
units = {length = "mm", angle = "deg"}
gravity = [0, 0]
ground = ["O"]
link = [
  {name = "upper", pins = ["O", "A"], mass = 0.1},
  {name = "lower", pins = ["A", "B"], mass = 0.1},
  {name = "ram", pins = ["B"], mass = 0.1, width = 10},
]
slide = [{name = "guide", link = "ram", direction = [0, 1]}]
motor = [{name = "work", slide = "guide", motion = {type = "polynomial", coefficients = [0, "0 m/s", "5 m/s2"]}}]
load = [{pin = "A", force = ["-100 N", "0 N"]}]
[pins]
O = [0, 0]
A = [5, -60]
B = [0, -120]
"""


def test_statics_says_what_holds_a_toggle_clamp(tmp_path, capsys):
    """A force P at the knee of two links with a slope of 1 to 12 presses with 12 P / 2, in every position of the workpiece."""
    scene = tmp_path / "clamp.toml"
    scene.write_text(CLAMP)
    (found,) = results(capsys, "statics", scene, "--out", tmp_path / "s.csv")["equilibria"]
    assert found["efforts"]["work"] == pytest.approx(600.0, rel=1e-12)
    np.testing.assert_allclose(found["forces"]["O"]["upper"], [50.0, -600.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found["forces"]["guide"]["ram"][:2], [50.0, 0.0], atol=1e-9)
    (row,) = csv.DictReader((tmp_path / "s.csv").open())
    assert float(row["effort.work [N]"]) == found["efforts"]["work"]
    assert float(row["pin.O.upper.fy [N]"]) == found["forces"]["O"]["upper"][1]
    assert udkjax("statics", scene) == 0
    assert re.search(r"work holds by +600 N\n +at O on upper +602.08 N: \(50, -600\) N\n", capsys.readouterr().out)
    assert udkjax("statics", EXAMPLES / "parallelogram.toml") == 0
    assert "not unique: of least norm" in capsys.readouterr().out


def test_the_only_driver_is_meant_and_channels_are_written_and_drawn(tmp_path, capsys):
    scene, out, plot = EXAMPLES / "slider_crank.toml", tmp_path / "k.csv", tmp_path / "k.png"
    found = results(capsys, "kinematics", scene, "--count", 7, "--channels", "pin.P.x", "--out", out, "--plot", plot)
    assert found["driver"] == "motor" and plot.stat().st_size > 1000
    rows = list(csv.DictReader(out.open()))
    x = [float(row["pin.P.x [m]"]) for row in rows]
    np.testing.assert_allclose(x, [2 * float(row["body.crank.x [m]"]) for row in rows], atol=1e-12)  # from the crank's middle
    np.testing.assert_allclose(found["channels"]["pin.P.x"], x)
    assert udkjax("kinematics", EXAMPLES / "four_bar.toml") == 2
    assert "name a coordinate, such as body.crank.angle" in capsys.readouterr().err
    assert udkjax("kinematics", scene, "--channels", "pin.Q.x") == 2
    assert '--channels pin.Q.x: no pin named "Q"' in capsys.readouterr().err


def test_reactions_at_pins_carry_what_moves(tmp_path, capsys):
    out, plot = tmp_path / "r.csv", tmp_path / "r.png"
    found = results(capsys, "reactions", EXAMPLES / "six_bar.toml", "--t1", 0.1, "--out", out, "--plot", plot)
    assert found["result"] == "successful" and plot.stat().st_size > 1000
    rows = list(csv.DictReader(out.open()))
    for pin, at in found["peaks"].items():
        for body, peak in at.items():
            force = [math.hypot(*(float(row[f"pin.{pin}.{body}.{c} [N]"]) for c in ("fx", "fy"))) for row in rows]
            assert peak["force"] == pytest.approx(max(force))


@pytest.mark.slow
def test_inverse_and_simulate_draw_what_they_find(tmp_path, capsys):
    plot = tmp_path / "i.png"
    results(capsys, "inverse", EXAMPLES / "slider_crank.toml", "--t1", 0.3, "--dt", 0.1, "--plot", plot)
    assert plot.stat().st_size > 1000
    out = tmp_path / "s.csv"
    scene = EXAMPLES / "slider_crank.toml"
    found = results(capsys, "simulate", scene, "--t1", 0.2, "--dt", 0.1, "--out", out, "--channels", "driver.motor.load")
    assert [Path(name).name for name in found["files"]] == ["s.csv", "s.png", "s-channels.png"]
    for row in csv.DictReader(out.open()):
        assert float(row["driver.motor.load [N m]"]) == pytest.approx(float(row["effort.motor [N m]"]), rel=1e-9)


def test_kinematics_says_what_the_links_do(tmp_path, capsys):
    """A crank of 50 and a ground of 100 between arms of 125, by hand; and a mechanism with undetermined positions."""
    hoeken = """
format = 2
units = {length = "mm"}
ground = ["O", "C"]
pins = {O = [0, 0], A = [-50, 0], B = [25, 100], C = [100, 0]}
motor = [{pin = "O", speed = "60 rpm"}]
[[link]]
name = "crank"
pins = ["O", "A"]
mass = 1
[[link]]
name = "coupler"
pins = ["A", "B"]
mass = 1
[[link]]
name = "rocker"
pins = ["C", "B"]
mass = 1
"""
    scene = tmp_path / "hoeken.toml"
    scene.write_text(hoeken)
    assert udkjax("kinematics", scene) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "values count the angle of O-A from the x axis" in said and "travel unlimited" in said and "angle at A" not in said
    assert "361 values from 180 deg to 540 deg" in said and "velocities at 6.28319 rad/s (60 rpm) of motor1" in said
    assert "transmission angle at B 23.0739 to 73.7398 deg" in said  # 2 asin(50 / 250), 2 asin(150 / 250)
    assert "crank-rocker (O-A-B-C: shortest + longest < sum of the others)" in said and "mobility 1, by Gruebler" in said
    few = results(capsys, "kinematics", scene, "--count", 3)["characteristics"]["transmission_angles"]["B"]
    np.testing.assert_allclose(few, 2 * np.arcsin([0.2, 0.6]), rtol=1e-12)  # however few values are asked for
    assert udkjax("kinematics", scene, "--at", "180 deg", "--rate", "10 rad/s") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "at 180 deg, the angle of O-A from the x axis; at 10 rad/s (95.493 rpm)" in said and "A -50 0 500 -90 5000 0" in said
    assert "links x (mm) y (mm) ground and crank 0 0" in said
    for wrong in (["--at", "5 mm"], ["--from", "x"], ["--at", "1 rad", "--count", "3"], ["--rate", "3 m"]):
        assert udkjax("kinematics", scene, *wrong) == 2
        assert wrong[0] in capsys.readouterr().err
    loose = hoeken.replace('name = "rocker"\npins = ["C", "B"]', 'name = "wheel"\npins = ["B"]\nwidth = 9')
    scene.write_text(loose.replace('ground = ["O", "C"]', 'ground = ["O"]').replace(", C = [100, 0]", ""))
    assert udkjax("kinematics", scene) == 2
    assert "drive or hold what still moves, coupler and wheel, by drivers" in capsys.readouterr().err


def test_warnings_are_said_without_places_in_the_code(capsys):
    with exit_codes(), warnings.catch_warnings(action="always"):
        warnings.warn(AssemblyWarning("assembly moved lever"), stacklevel=1)
    assert capsys.readouterr().err == "udkjax: assembly moved lever\n"
