"""The PTX that LLVM writes for a kernel, as C: a test of the code for graphics cards on machines without one.

It is no test of `ptxas`, nor of threads that run at the same time. Pointers to local and shared memory are checked when they are
cast: they must point there.
"""

import ctypes
import re
import subprocess
from pathlib import Path

HEAD = """#include <stdint.h>
#include <string.h>
#include <stdlib.h>
#include <math.h>
typedef uint64_t u; typedef int64_t s;
static inline double D(u x) {double d; memcpy(&d, &x, 8); return d;}
static inline u U(double d) {u x; memcpy(&x, &d, 8); return x;}
static u tid_x, ctaid_x, ntid_x, stack;
static u in_stack(u x) {u here = (u)__builtin_frame_address(0); if (x < here || x > stack) abort(); return x;}
static u in_block(u x, void *begin, u size) {if (x < (u)begin || x > (u)begin + size) abort(); return x;}
"""
TYPES = {"b64": "u", "u64": "u", "f64": "u", "b32": "uint32_t", "b16": "uint16_t", "pred": "int"}
COMPARE = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
UNORDERED = {"equ": "ne", "neu": "eq", "ltu": "ge", "leu": "gt", "gtu": "le", "geu": "lt"}
SIGNS = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
OF_DOUBLES = {
    "neg": "-{}", "abs": "fabs({})", "sqrt": "sqrt({})", "rcp": "1.0 / {}", "fma": "fma({}, {}, {})", "max": "fmax({}, {})",
    "min": "fmin({}, {})", "copysign": "copysign({1}, {0})",
    "rni": "rint({})", "rzi": "trunc({})", "rmi": "floor({})", "rpi": "ceil({})",
}  # fmt: skip
OF_WHOLE = {
    "add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "mad": "{} * {} + {}", "and": "{} & {}", "or": "{} | {}",
    "xor": "{} ^ {}", "not": "!{}", "shl": "{} << {}", "shr": "{} >> {}",
}  # fmt: skip
KINDS = {"b8": "uint8_t", "b32": "uint32_t", "b64": "u"}


def operand(x: str) -> str:
    x = x.strip()
    if x.startswith("0d"):
        return f"0x{x[2:]}ULL"
    if re.fullmatch(r"-?\d+", x):
        return "0x8000000000000000ULL" if x == "-9223372036854775808" else f"((u)(s){x}LL)"
    if re.fullmatch(r"0x[0-9A-F]+", x):
        return f"{x}ULL"
    x = x.lstrip("%").replace(".", "_")
    return x if re.fullmatch(r"(rd|r|p|rs)\d+|[pq]|SPL?|(n?tid|ctaid)_x|param\d+|\w*retval\d+|\w+_param_\d+", x) else f"((u){x})"


def place(x: str) -> str:
    base, _, offset = x.strip(" []").partition("+")
    return f"({operand(base)} + {offset or 0})"


def compared(kind: str, type_: str, a: str, b: str) -> str:
    if type_ != "f64":
        cast = "(s)" if type_[0] == "s" else ""
        return f"{cast}{a} {COMPARE[kind]} {cast}{b}"
    if kind == "nan":
        return f"isnan(D({a})) || isnan(D({b}))"
    if kind == "num":
        return f"!isnan(D({a})) && !isnan(D({b}))"
    if kind == "ne":  # ordered
        return f"D({a}) < D({b}) || D({a}) > D({b})"
    if kind in COMPARE:
        return f"D({a}) {COMPARE[kind]} D({b})"
    return f"!({compared(UNORDERED[kind], type_, a, b)})"


def instruction(text: str) -> str:
    """One instruction as C."""
    if guard := re.match(r"@(!?)%(p\d+)\s+", text):
        return f"if ({guard[1]}{guard[2]}) {instruction(text[guard.end() :])}"
    name, _, rest = text.partition(" " if " " in text and "\t" not in text else "\t")
    name, parts = name.strip(), name.strip().split(".")
    if name == "ret":
        return "goto leave;"
    if parts[0] == "bra":
        return f"goto {rest.strip().lstrip('$')};"
    if parts[0] == "call":
        result = re.match(r"\((\w+)\),\s*(.*)", rest.strip())
        function, _, given = (result[2] if result else rest.strip()).partition(",")
        return f"{f'{result[1]} = ' if result else ''}{function}({given.strip(' ()')});"
    if name == "barrier.cta.red.or.pred":
        q, _, p = (x.strip() for x in rest.split(","))
        return f"{q} = {p};"
    a = re.split(r",\s*(?![^\[]*\])", rest.strip())
    if "v2" in parts:
        pair = [operand(x) for x in rest[rest.index("{") + 1 : rest.index("}")].split(",")]
        at = rest[rest.index("[") + 1 : rest.index("]")]
        both = [(pair[k], f"((u *){place(at)})[{k}]") for k in (0, 1)]
        return " ".join(f"{x} = {y};" if parts[0] == "ld" else f"{y} = {x};" for x, y in both)
    if parts[0] == "ld":
        if parts[1] == "param" and "%" not in a[1]:
            return f"{operand(a[0])} = {operand(a[1].strip('[]'))};"
        return f"{operand(a[0])} = *({KINDS[parts[-1]]} *){place(a[1])};"
    if parts[0] == "st":
        if parts[1] == "param":
            return f"{operand(a[0].strip('[]'))} = {operand(a[1])};"
        return f"*({KINDS[parts[-1]]} *){place(a[0])} = {operand(a[1])};"
    to, x = operand(a[0]), [operand(k) for k in a[1:]]
    d = [f"D({k})" for k in x]
    if parts[0] == "setp":
        return f"{to} = {compared(parts[1], parts[-1], x[0], x[1])};"
    if parts[0] == "selp":
        return f"{to} = {x[2]} ? {x[0]} : {x[1]};"
    if name == "cvta.to.local.u64":
        return f"{to} = in_stack({x[0]});"
    if name == "cvta.to.shared.u64":
        return f"{to} = in_block({x[0]}, block_memory, sizeof(block_memory));"
    if name == "cvt.s64.s32" or name.startswith("mul.wide.s32"):
        return f"{to} = (u)((s)(int32_t){') * (s)(int32_t)('.join(x)});"
    if name.startswith("mul.wide.u32"):
        return f"{to} = (u)(uint32_t){x[0]} * (u)(uint32_t){x[1]};"
    if parts[0] in ("mov", "cvta") or re.fullmatch(r"cvt.u\d+.u\d+", name):
        return f"{to} = {x[0]};"
    if name == "cvt.rzi.s64.f64":
        return f"{to} = (u)(s){d[0]};"
    if name == "cvt.rn.f64.s64":
        return f"{to} = U((double)(s){x[0]});"
    if name == "cvt.rn.f64.u32":
        return f"{to} = U((double)(uint32_t){x[0]});"
    if parts[0] == "bfe":
        return f"{to} = {x[0]} >> {x[1]} & ((1ULL << {x[2]}) - 1);"
    if parts[0] == "cvt" and parts[2:] == ["f64", "f64"]:
        return f"{to} = U({OF_DOUBLES[parts[1]].format(*d)});"
    if parts[-1] == "f64":
        return (
            f"{to} = U({d[0]} {SIGNS[parts[0]]} {d[1]});"
            if parts[0] in SIGNS
            else f"{to} = U({OF_DOUBLES[parts[0]].format(*d)});"
        )
    if parts[:2] == ["mul", "hi"]:
        return f"{to} = (u)(((unsigned __int128){x[0]} * {x[1]}) >> 64);"
    if parts[0] == "shr" and parts[-1][0] == "s":
        return f"{to} = (u)((s){x[0]} >> {x[1]});"
    if parts[0] in ("max", "min"):
        sign, cast = "><"[parts[0] == "min"], "(s)" if parts[-1][0] == "s" else ""
        return f"{to} = {cast}{x[0]} {sign} {cast}{x[1]} ? {x[0]} : {x[1]};"
    return f"{to} = {OF_WHOLE[parts[0]].format(*x)};"


def as_c(code: str) -> str:
    """The source: `run(record, members)` runs the threads of one block one after another."""
    lines, heads, returns = [HEAD], [], []
    code = re.sub(r"\{(?= \.reg)", "{\n", re.sub(r"//.*", "", code))

    def define(match: re.Match) -> str:
        result, name, given = match[1], match[2], re.findall(r"\w+_param_\d+", match[3])
        heads.append(f"static {'u' if result else 'void'} {name}({', '.join(f'u {x}' for x in given)})")
        returns.append(re.sub(r".*?(\w*retval\d+).*", r"\1", result, flags=re.DOTALL) if result else None)
        return f"DEFINE {len(heads) - 1}\n"

    code = re.sub(r"\.visible \.func\s+(?:\([^)]*\)\s*)?\w+\s*\([^)]*\)\s*(?:\.noinline\s*)?;", "", code)
    code = re.sub(r"\.visible \.(?:func|entry)\s*(\([^)]*\))?\s*(\w+)\s*\(([^)]*)\)\s*(?:\.noinline\s*)?", define, code)
    lines += [f"{head};" for head in heads]
    depth = result = 0
    for line in (x.strip().rstrip(";") for x in re.sub(r";(?=.)", ";\n", code).split("\n")):
        if table := re.match(
            r"(?:\.visible )?\.(?:global|shared) \.align (\d+) \.([bu])(\d+) ([\w$]+)\[(\d+)\](?: = (\{.*\}))?", line
        ):
            value = f" = {table[6]}" if table[6] else ""
            lines.append(f"static uint{table[3]}_t {table[4]}[{table[5]}] __attribute__((aligned({table[1]}))){value};")
        elif line.startswith("DEFINE"):
            result = returns[int(line.split()[1])]
            lines.append(heads[int(line.split()[1])])
        elif memory := re.match(r"\.local \.align (\d+) \.b8\s+(\w+)\[(\d+)\]", line):
            lines.append(f"uint8_t {memory[2]}[{memory[3]}] __attribute__((aligned({memory[1]})));")
        elif registers := re.match(r"\.reg \.(\w+)\s+%?(\w+)(?:<(\d+)>)?(.*)", line):
            each = [f"{registers[2]}{k}" for k in range(1, int(registers[3]))] if registers[3] else [registers[2]]
            each += [x.strip(" ,%") for x in registers[4].split(",") if x.strip(" ,")]
            lines.append(f"{TYPES[registers[1]]} {', '.join(each)};")
        elif parameter := re.match(r"\.param \.b(?:64|32)\s+(\w+)", line):
            lines.append(f"u {parameter[1]};")
        elif line in ("{", "}"):
            depth += 1 if line == "{" else -1
            if line == "{" and depth == 1:
                lines.append(f"{{ u {result};" if result else "{")
            else:
                lines.append(f"leave: return {result or ''};}}" if line == "}" and depth == 0 else line)
        elif line.startswith("$"):
            lines.append(line.lstrip("$"))
        elif line and not line.startswith("."):
            lines.append(instruction(line))
    lines.append("""void run(u record, u members) {
    stack = (u)__builtin_frame_address(0);
    ntid_x = members + 3;
    for (tid_x = 0; tid_x < ntid_x; tid_x++) run_members(record);
}""")
    return "\n".join(lines)


def compiled(code: str, folder: Path):
    """A C function of the address of a call record and the number of members."""
    (folder / "kernel.c").write_text(as_c(code))
    options = ["-O1", "-w", "-mfma", "-ffp-contract=off", "-fno-strict-aliasing", "-shared", "-fPIC"]
    subprocess.run(["cc", *options, str(folder / "kernel.c"), "-o", str(folder / "kernel.so"), "-lm"], check=True)
    run = ctypes.CDLL(str(folder / "kernel.so")).run
    run.argtypes = ctypes.c_uint64, ctypes.c_uint64
    return run
