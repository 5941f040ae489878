"""C and FMUs for other processors, compiled by the wheel `ziglang`, and run where QEMU emulates the processor."""

import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.portable.test_export_c import STRICT, TS
from tests.integrate.portable.test_export_fmu import DRIVE, Instance, pendulum, states

pytestmark = pytest.mark.slow
LOADER = Path("/usr/aarch64-linux-gnu/lib/ld-linux-aarch64.so.1")  # of Debian's package libc6-arm64-cross
ELF_AARCH64, PE_X86_64, ELF_ARM = 183, 0x8664, 40
DRIVER = """
#include <stdio.h>
#include "fmi3.h"
#include "model.h"
fmi3Instance fmi3InstantiateCoSimulation(); /* without the types of arguments, which calls give */
fmi3Status fmi3EnterInitializationMode(), fmi3ExitInitializationMode(), fmi3SetFloat64(), fmi3DoStep(), fmi3GetFloat64();
int main(void)
{
    const fmi3ValueReference drive = DRIVE, state[] = {1, 2, 3, 4, 5, 6};
    const fmi3Float64 torque = 0.5;
    const size_t one = 1, six = 6, none = 0;
    fmi3Float64 found[6], reached;
    fmi3Boolean event, end, early;
    void *null = 0;
    fmi3Instance m = fmi3InstantiateCoSimulation("m", TOKEN, null, 0, 0, 0, 0, null, none, null, null, null);
    int wrong = fmi3EnterInitializationMode(m, 0, 0.0, 0.0, 0, 0.0) || fmi3ExitInitializationMode(m);
    wrong = wrong || fmi3SetFloat64(m, &drive, one, &torque, one) || fmi3DoStep(m, 0.0, 0.1, 0, &event, &end, &early, &reached);
    wrong = wrong || fmi3GetFloat64(m, state, six, found, six);
    for (int k = 0; k < 6; k++) printf("%.17g\\n", found[k]);
    return wrong;
}
"""


@pytest.fixture(scope="module", autouse=True)
def zig():
    pytest.importorskip("ziglang")
    return f"{sys.executable} -m ziglang cc"


def run(command: str, folder: Path) -> str:
    return subprocess.run(command, shell=True, cwd=folder, check=True, capture_output=True, text=True).stdout


def table(text: str) -> np.ndarray:
    return np.array([[float(x) for x in line.split(",")] for line in text.splitlines()[1:]])


def machine(data: bytes) -> int:
    """Return the processor for which a library or an object is, in the number of its format."""
    if data[:4] == b"\x7fELF":
        return struct.unpack_from("<H", data, 18)[0]
    return struct.unpack_from("<H", data, struct.unpack_from("<I", data, 0x3C)[0] + 4)[0]


def test_fmus_for_three_platforms_are_made_on_one(tmp_path, zig):
    platforms: Any = ["x86_64-linux", "aarch64-linux", "x86_64-windows"]
    made = udk.export_fmu(pendulum(), tmp_path / "a.fmu", platforms=platforms, stiff=False, options=["-O1"])
    with zipfile.ZipFile(made.file) as archive:
        data = {x.split("/")[1]: archive.read(x) for x in archive.namelist() if x.startswith("binaries/")}
    assert made.platforms == platforms == [*data]
    assert [machine(data[x]) for x in platforms[1:]] == [ELF_AARCH64, PE_X86_64]
    assert all(b"fmi3DoStep" in x and b"fmi3GetDirectionalDerivative" in x for x in data.values())
    one = Instance(made.file, tmp_path / "a", "CoSimulation")
    assert one.begin() == one.set(**{DRIVE: 0.5}) == one.step(0.0, 0.1) == 0
    if not (shutil.which("qemu-aarch64") and LOADER.exists()):
        pytest.skip("the library for AArch64 was not run: apt install qemu-user libc6-arm64-cross")
    (tmp_path / "a" / "sources" / "driver.c").write_text(DRIVER.replace("DRIVE", str(one.references[DRIVE])))
    library = "../binaries/aarch64-linux/pendulum.so"
    flags = f"-std=c99 -target aarch64-linux-gnu.2.17 driver.c {library} -o driver -Wl,-rpath,'$ORIGIN/../binaries/aarch64-linux'"
    run(f"{zig} {flags}", tmp_path / "a" / "sources")
    found = run(f"qemu-aarch64 -L {LOADER.parents[1]} ./driver", tmp_path / "a" / "sources")
    assert_allclose([float(x) for x in found.split()], one.get(*states(pendulum())), rtol=1e-12, atol=1e-13)


def test_c_compiles_for_a_microcontroller(tmp_path, zig):
    code = udk.export_c(udk.library.parallelogram(), tmp_path, ["accelerations"])
    assert code.flops < 4000 and code.memory["accelerations"] < 16_000  # bytes
    run(f"{zig} {STRICT} -O2 -target thumb-linux-musleabihf -mcpu=cortex_m7 -c *_accelerations.c -o code.o", tmp_path)
    assert machine((tmp_path / "code.o").read_bytes()) == ELF_ARM


@pytest.mark.parametrize(("emulator", "target"), [("qemu-aarch64", "aarch64-linux-musl"), ("qemu-arm", "arm-linux-musleabihf")])
def test_other_processors_print_the_same_motion(tmp_path, zig, emulator, target):
    if shutil.which(emulator) is None:
        pytest.skip(f"there is no {emulator}: apt install qemu-user")
    udk.export_c(udk.library.parallelogram(), tmp_path, ["run"], TS, stiff=False)
    run(f"cc {STRICT} -O1 *.c -o here -lm && {zig} {STRICT} -O1 -static -target {target} *.c -o there -lm", tmp_path)
    there, here = table(run(f"{emulator} ./there", tmp_path)), table(run("./here", tmp_path))
    print(f"{target}: largest difference {np.abs(there - here).max():.1e}")  # shown by pytest -s; the motion amplifies rounding
    assert_allclose(there, here, rtol=0.0, atol=1e-9)
