"""Measurements from files, mappings, pandas and xarray: the same records from all, and every mistake reported."""

import math

import numpy as np
import pandas
import pytest
import xarray
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.cli.datasets import save
from udkjax.positions.assembling.channels import Quantity
from udkjax.scene.numbers.quantities import conversion_factor
from udkjax.study.identify.records.record_reader import records_of
from udkjax.study.identify.records.records import IdentificationError, Record, Start

DEG = math.pi / 180


@pytest.fixture(scope="module")
def mech():
    return udk.library.slider_crank()


@pytest.fixture
def file(tmp_path):
    """Write a file; return its path."""

    def write(text: str, name: str = "motion.csv"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def problems(mech, data, **settings) -> list[str]:
    """Return the mistakes in data."""
    with pytest.raises(IdentificationError) as error:
        records_of(mech, data, **settings)
    return error.value.problems


def sigma(record: Record, channel: str | Quantity) -> np.ndarray:
    """Return the standard deviation given for a channel."""
    found = record.noise[channel]
    assert found is not None
    return found


# --- CSV


CSV = """\
# made on Monday
# by the rig

time [ms], body.crank.angle [deg], body.rod(0.5, 0).x [mm], joint.O.omega [rpm], joint.O.omega.noise, remarks
0, 90, 1500, 60, 6,
10, , 1400, nan, 6, lost
20, -45, 1300, 30, 12, found
"""


def test_a_file_is_read_in_si_units(mech, file):
    (record,) = records_of(mech, file(CSV), noise={"body.crank.angle": 0.01}, ignore=["remarks"])
    assert record.name == "motion" and record.t0 == 0.0
    assert_allclose(record.times, [0.0, 0.01, 0.02], rtol=1e-15)
    assert list(record.values) == ["body.crank.angle", "body.rod(0.5, 0.0).x", "joint.O.omega"]
    assert_allclose(record.values["body.crank.angle"], [math.pi / 2, np.nan, -math.pi / 4], rtol=1e-15)
    assert_allclose(record.values["body.rod(0.5, 0.0).x"], [1.5, 1.4, 1.3], rtol=1e-15)
    assert_allclose(record.values["joint.O.omega"], [2 * math.pi, np.nan, math.pi], rtol=1e-15)
    assert_allclose(sigma(record, "joint.O.omega"), 2 * math.pi * np.array([0.1, 0.1, 0.2]), rtol=1e-15)
    assert_allclose(sigma(record, "body.crank.angle"), 0.01)
    assert record.noise["body.rod(0.5, 0.0).x"] is None


def test_a_column_splits_a_file_into_records(mech, file):
    text = "record,t,body.crank.angle,body.slider.x\n1,0,1,\nb,0,5,7\n1,0.5,2,\nb,0.1,6,8\n"
    first, second = records_of(mech, file(text))
    assert (first.name, second.name) == ("1", "b")
    assert_allclose(first.times, [0, 0.5])
    assert list(first.values) == ["body.crank.angle"]  # what was not measured is left out
    assert_allclose(second.times, [0, 0.1])
    assert_allclose([second.values["body.crank.angle"], second.values["body.slider.x"]], [[5, 6], [7, 8]])


def test_files_of_other_delimiters_and_editors(mech, file):
    quoted = records_of(mech, file('\ufefftime;"body.rod(0.5, 0).x [cm]";;\r\n0;100;;\r\n\r\n1;200\r\n'))
    tabbed = records_of(mech, file("time\tbody.rod(0.5, 0).x\n0\t1\n1\t2\n"))
    for (record,) in (quoted, tabbed):
        assert_allclose(record.values["body.rod(0.5, 0.0).x"], [1.0, 2.0])


def test_all_mistakes_of_a_file_are_told_at_once(mech, file):
    path = file(
        "time [s],body.cranc.angle,body.rod.x [deg],body.rod.y [furlong],body.rod.vx,joint.O.fx.noise,what\n"
        "0,1,1,1,1,1,1\n0.2,1,1,1,x,1,1\n0.1,1,1,1,1,1,1\n0.3,1,1\n"
    )
    found = problems(mech, path)
    assert found[:1] == [f"{path}, line 5: has 3 cells, the header has 7"]
    rest = [problem.removeprefix(f"{path}, ") for problem in found[1:]]
    assert [problem.split(":")[0] for problem in rest] == [
        'column "body.cranc.angle"',
        'column "joint.O.fx.noise"',
        'column "what"',
        'column "body.rod.x"',
        'column "body.rod.y"',
        'line 3, column "body.rod.vx"',
        'line 4, column "time"',
    ]
    text = "\n".join(rest)
    for part in (
        'no body named "cranc"; did you mean "crank"? (list columns that are not to be read in `ignore`)',
        'there is no column "joint.O.fx"',
        '"deg" does not fit; it is measured in m, mm, cm',
        '"furlong" is not a known unit',
        'must be a number, not "x"',
        "0.1 s does not exceed the previous time, 0.2 s",
    ):
        assert part in text


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "has no header"),
        ("# nothing\n", "has no header"),
        ("body.crank.angle\n1\n", 'there is no column "time"'),
        ("Time,body.crank.angle\n0,1\n", 'did you mean "Time"?'),
        ("time,body.crank.angle,body.crank.angle [deg]\n0,1,1\n", 'there are two columns "body.crank.angle"'),
        ("time,body.rod(0,0).x,body.rod.x,body.rod(0.0,0).x\n0,1,1,1\n", 'is the same channel as "body.rod(0,0).x"'),
        ("time,body.crank.angle\n,1\n", 'line 2, column "time": is empty'),
        ("time,body.crank.angle\n0,1\n1,inf\n", 'line 3, column "body.crank.angle": must be a number, not "inf"'),
        ("time;body.crank.angle\n0;0,5\n", 'must be a number, not "0,5"'),
        ("time,body.crank.angle,\n0,1,2\n", "line 2: has 3 cells, the header has 2"),
        ("time,,body.crank.angle\n0,1,2\n", "a column has no heading"),
        ("time,body.crank.angle,record\n0,1,\n", 'line 2, column "record": is empty'),
        ("time,body.crank.angle\n0,\n", "nothing was measured"),
        ("time,body.crank.angle,body.crank.angle.noise\n0,1,0\n", "a standard deviation must be a finite number > 0"),
        ("time,body.crank.angle,body.crank.angle.noise [m]\n0,1,1\n", 'column "body.crank.angle.noise": "m" does not fit'),
    ],
)
def test_a_mistake_in_a_file_says_where_it_is(mech, file, text, problem):
    path = file(text)
    found = "\n".join(problems(mech, path))
    assert problem in found and str(path) in found


def test_a_mistake_in_every_row_is_told_a_few_times(mech, file):
    found = problems(mech, file("time,body.crank.angle\n" + "".join(f"{k},x\n" for k in range(50))))
    assert len(found) == 4 and found[-1].endswith("the same in 47 more rows")


def test_files_that_cannot_be_read_are_told(mech, file, tmp_path):
    latin = tmp_path / "latin.csv"
    latin.write_bytes("time,body.crank.angle [°]\n0,1\n".encode("latin-1"))
    found = problems(mech, [tmp_path / "none.csv", latin, tmp_path / "motion.mat", 3.0, file("junk", "junk.nc")])
    for problem, part in zip(
        found,
        ("No such file", "can't decode", "must be a .csv or a .nc file", "data[3]: must be a Record", "cannot be read"),
        strict=True,
    ):
        assert part in problem


# --- mappings, pandas, xarray: the same as from a file


@pytest.mark.parametrize("kind", [dict, pandas.DataFrame, lambda table: pandas.DataFrame(table).set_index("time [ms]")])
@pytest.mark.parametrize("by_name", [True, False])
def test_mappings_and_frames_read_as_files_do(mech, kind, by_name):
    spin = Quantity("spin", lambda mech, solution: solution.v[:, 0, 2], "N m s")
    table = {
        "time [ms]": [0, 10],
        "body.crank.angle [deg]": np.array([90.0, 180.0]),
        "body.crank.angle.noise": [0.9, 0.9],
        "body.rod.x [mm]": [None, 1.0],
        "spin" if by_name else spin: [1, 2],
    }
    noise = {"spin" if by_name else spin: 0.1}
    (record,) = records_of(mech, kind(table), noise, quantities=[spin] if by_name else ())
    assert_allclose(record.times, [0.0, 0.01])
    assert_allclose(record.values["body.crank.angle"], [math.pi / 2, math.pi])
    assert_allclose(record.values["body.rod.x"], [np.nan, 1e-3])
    assert_allclose(record.values[spin], [1.0, 2.0])
    assert_allclose(sigma(record, "body.crank.angle"), 0.9 * DEG)
    assert_allclose(sigma(record, spin), 0.1)
    assert record.noise["body.rod.x"] is None and records_of(mech, record) == (record,)


def test_one_standard_deviation_serves_a_whole_column(mech):
    (record,) = records_of(mech, {"time": [0.0, 1.0], "body.crank.angle [deg]": [1, 2], "body.crank.angle.noise": 2.0})
    assert_allclose(sigma(record, "body.crank.angle"), [2 * DEG, 2 * DEG])


def test_mistakes_in_mappings_say_which_and_where(mech):
    dates = {"time": np.array(["2025-01-01", "2025-01-02"], "datetime64[s]"), "body.crank.angle": [1, 2]}
    lengths = {"time": [0, 1], "body.crank.angle": [1, 2, 3], "body.rod.x": [True, 2, 3]}
    found = problems(mech, [dates, lengths], noise={"body.crank.omega": 1.0, "crank": 1.0})
    for problem, part in zip(
        found,
        (
            'data[0], column "time": must be 2 numbers, but is of type datetime64[s]',
            'data[1], column "time": must be 3 numbers, but is of shape (2,)',
            'data[1], entry 0, column "body.rod.x": must be a number, not true',
            'noise, "crank": begins with none of',
            'noise: "body.crank.omega" is not measured in any record',
        ),
        strict=True,
    ):
        assert part in problem


def test_records_keep_what_they_know(mech):
    start = Start(estimate="velocity")
    given = Record(
        [0.0, 1.0], {"body.rod(0, 0).x": [1.0, 2.0], "body.rod.y": [1.0, 2.0]}, {"body.rod.y": 0.5}, start, -1.0, {"a": 2.0}
    )
    (kept,) = records_of(mech, given)
    assert list(kept.values) == ["body.rod(0.0, 0.0).x", "body.rod.y"]
    (known,) = records_of(mech, [given], noise=0.25)
    assert known.start is start and known.t0 == -1.0 and known.conditions == {"a": 2.0}
    assert [float(sigma[0]) for sigma in known.noise.values() if sigma is not None] == [0.25, 0.5]
    (same,) = records_of(mech, known)
    assert same is known
    wrong = Record([0.0], {"body.rot.x": [1.0]}, name="third")
    assert problems(mech, wrong) == ['record "third", "body.rot.x": no body named "rot"; did you mean "rod"?']


def test_a_dataset_reads_as_a_file_does_and_so_does_its_file(mech, tmp_path):
    angle = [[90.0, 180.0, np.nan], [np.nan, 45.0, 0.0]]
    data = xarray.Dataset(
        {"body.crank.angle": (("record", "time"), angle, {"units": "degrees"}), "body.crank.angle.noise": ("record", [1.8, 3.6])},
        {"time": ("time", [0.0, 100.0, 200.0], {"units": "ms"}), "record": ["up", "down"], "run": ("record", [1, 2])},
    )
    data.to_netcdf(tmp_path / "motion.nc")
    for source in (data, tmp_path / "motion.nc"):
        up, down = records_of(mech, source)
        assert (up.name, down.name) == ("up", "down")
        assert_allclose(up.times, [0.0, 0.1])  # the others are those of the other record
        assert_allclose(down.times, [0.1, 0.2])
        assert_allclose(up.values["body.crank.angle"], [math.pi / 2, math.pi])
        assert_allclose(down.values["body.crank.angle"], [math.pi / 4, 0.0])
        assert_allclose([sigma(up, "body.crank.angle")[0], sigma(down, "body.crank.angle")[0]], [1.8 * DEG, 3.6 * DEG])
    single = data.isel(record=0, drop=True).rename(time="t")
    (record,) = records_of(mech, single)
    assert len(record.times) == 3
    found = problems(mech, data.assign(extra=("side", [1.0])).rename(time="instant"))
    assert found == ['data: there is no coordinate "time"']
    assert problems(mech, data.assign(extra=("side", [1.0]))) == ['data, "extra": must be along "time", not along ["side"]']


def test_padded_records_keep_the_rows_of_channels_that_are_measured_apart(mech):
    """Only rows without any value pad a record; a channel may begin or end before another, and share no row with it."""
    nan = np.nan
    angle = [[nan, 1.0, nan, 3.0, nan, nan], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]]
    x = [[nan, nan, 2.0, nan, 4.0, nan], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]]
    names = "body.crank.angle", "body.rod.x"
    data = xarray.Dataset({n: (("record", "time"), a) for n, a in zip(names, (angle, x))}, {"time": np.arange(6.0)})
    apart, whole = records_of(mech, data)
    assert_allclose(apart.times, [1.0, 2.0, 3.0, 4.0])
    assert_allclose(apart.values[names[0]], [1.0, nan, 3.0, nan])
    assert_allclose(apart.values[names[1]], [nan, 2.0, nan, 4.0])
    assert len(whole.times) == 6


def test_what_a_solution_writes_can_be_measured(mech):
    q, v = np.arange(18.0).reshape(2, 3, 3), -np.arange(18.0).reshape(2, 3, 3)
    coords = {"time": [0.0, 0.5], "body": list(mech.body_names), "coordinate": ["x", "y", "angle"]}
    data = xarray.Dataset({"q": (tuple(coords), q), "v": (tuple(coords), v)}, coords)
    (record,) = records_of(mech, data)
    assert len(record.values) == 18
    assert_allclose(record.values["body.rod.angle"], q[:, 1, 2])
    assert_allclose(record.values["body.slider.vy"], v[:, 2, 1])
    other = data.assign_coords(body=["crank", "rods", "slider"])
    assert problems(mech, other[["q"]]) == ['data, "q": no body named "rods"; did you mean "rod"?']


@pytest.fixture(scope="module")
def with_motors():
    """A mechanism with two drivers, and the dataset of a run of it with events."""
    still = udk.library.slider_crank()
    drivers = {
        name: udk.Driver(("ground", body), "angle", udk.Polynomial([0.0])) for name, body in (("motor", "crank"), ("idle", "rod"))
    }
    mech = udk.Mechanism(still.bodies, still.joints, drivers=drivers)
    ts, count = np.array([0.0, 0.5]), len(mech.body_names)
    dims = "time", "body", "coordinate"
    coords = {"time": ts, "body": list(mech.body_names), "coordinate": ["x", "y", "angle"], "driver": list(drivers)}
    data = xarray.Dataset({"q": (dims, np.ones((2, count, 3))), "v": (dims, np.ones((2, count, 3)))}, coords)
    data["effort"] = ("time", "driver"), np.array([[1.0, 2.0], [3.0, 4.0]]), {"units": "N m or N"}
    data["holds"] = ("time", "constraint"), np.ones((2, 1), np.int8)
    return mech, data.assign_coords(constraint=["stop"])


@pytest.mark.parametrize("suffix", ["", ".nc", ".csv"])
@pytest.mark.parametrize("with_channel", [False, True])
def test_files_of_runs_with_drivers_and_events_are_records(with_motors, suffix, with_channel, tmp_path):
    mech, data = with_motors
    if with_channel:
        data = data.assign({"driver.motor.load": ("time", [1.0, 3.0], {"units": "N m"})})
    source = tmp_path / f"run{suffix}" if suffix else data
    if suffix:
        save(data, source)
    (record,) = records_of(mech, source)
    assert_allclose(record.values["driver.motor.load"], [1.0, 3.0])
    assert_allclose(record.values["driver.idle.load"], [2.0, 4.0])
    assert len(record.values) == 6 * len(mech.body_names) + 2


def test_efforts_may_be_ignored_and_name_their_driver(with_motors):
    mech, data = with_motors
    (record,) = records_of(mech, data, ignore=["effort"])
    assert not any(str(key).startswith("driver") for key in record.values)
    (record,) = records_of(mech, data, ignore=["effort.idle"])
    assert "driver.motor.load" in record.values and "driver.idle.load" not in record.values
    (told,) = problems(mech, data[["effort"]].assign_coords(driver=["moter", "idle"]))
    assert told.startswith('data, column "effort.moter": no driver named "moter"; did you mean "motor"?')


def test_variables_of_datasets_along_other_dimensions_may_be_ignored(mech):
    data = xarray.Dataset({"body.crank.angle": ("time", [1.0, 2.0]), "extra": ("side", [1.0])}, {"time": [0.0, 1.0]})
    (record,) = records_of(mech, data, ignore=["extra"])
    assert list(record.values) == ["body.crank.angle"]


# --- units


@pytest.mark.parametrize(
    ("units", "wanted", "expected"),
    [
        ("deg", "rad", DEG),
        ("°/s", "rad/s", DEG),
        ("deg/s^2", "rad/s2", DEG),
        ("rpm", "rad/s", math.pi / 30),
        ("rev/min", "rad/s", math.pi / 30),
        ("mm", "m", 1e-3),
        ("cm/s", "m/s", 1e-2),
        ("mm/s2", "m/s2", 1e-3),
        ("m/s^2", "m/s2", 1.0),
        ("m/s**2", "m/s2", 1.0),
        ("m/s²", "m/s2", 1.0),
        ("m s^-2", "m/s2", 1.0),
        ("m/s/s", "m/s2", 1.0),
        ("g", "m/s2", 9.80665),
        ("g", "kg", 1e-3),
        ("µs", "s", 1e-6),
        ("kN", "N", 1e3),
        ("kN m", "N m", 1e3),
        ("kN·m", "N m", 1e3),
        ("N*mm", "N m", 1e-3),
        ("Nmm", "N m", 1e-3),
        ("kg m/s2", "N", 1.0),
        ("N m/deg", "N m/rad", 180 / math.pi),
        ("bushels", "bushels", 1.0),
    ],
)
def test_units_are_told_as_people_write_them(units, wanted, expected):
    assert_allclose(conversion_factor(units, wanted), expected, rtol=1e-15)


@pytest.mark.parametrize(
    ("units", "wanted", "problem"),
    [
        ("mm", "rad", '"mm" does not fit; it is measured in rad, deg, rev'),
        ("N", "N m", "it is measured in N m, N mm, kN m"),
        ("rad/s", "rad/s2", "it is measured in rad/s2, deg/s2"),
        ("Hz", "rad/s", '"Hz" is not a known unit; cycles a second are rev/s'),
        ("5 m", "m", "is not a known unit"),
        ("%", "m", "is not a known unit"),
    ],
)
def test_units_that_do_not_fit_are_refused(units, wanted, problem):
    with pytest.raises(ValueError, match=problem):
        conversion_factor(units, wanted)
