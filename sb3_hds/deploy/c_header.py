"""An exported policy as one header of C99: no allocation, no library but libm."""

import dataclasses
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_hds.core.trajectories.storage import write_bytes
from sb3_hds.deploy.c_operations import Translation
from sb3_hds.deploy.onnx_policy import OnnxPolicy
from sb3_hds.errors import ExportError

#: number of calls that are compared, and timed
N_CHECKED, N_TIMED = 1_000, 20_000
#: largest difference to onnxruntime, relative to half the range of each action
TOLERANCE = 1e-5
_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wno-unused-function", "-pedantic", "-Werror")


@dataclasses.dataclass(frozen=True)
class Header:
    """
    A C header.

    :param path: of the header
    :param n_bytes: size of its text
    :param constant_bytes: of weights and other constants
    :param stack_bytes: used by one call
    :param n_operations: multiplications, additions and functions in one call
    :param largest_error: relative to onnxruntime and half the range; None: no compiler was found
    :param median: time of one call on this machine [s]; None: no compiler was found
    :param worst: longest time of one call [s]; None: no compiler was found
    """

    path: Path
    n_bytes: int
    constant_bytes: int
    stack_bytes: int
    n_operations: int
    largest_error: float | None = None
    median: float | None = None
    worst: float | None = None

    def __str__(self) -> str:
        lines = [
            f"{self.path}: {self.n_bytes / 1024:.1f} KiB of C99",
            f"  {self.constant_bytes:,} bytes of constants, {self.stack_bytes:,} of stack, "
            f"{self.n_operations:,} operations",
        ]
        if self.largest_error is None:
            lines.append("  not compiled: there is no command cc")
            return "\n".join(lines)
        assert self.median is not None and self.worst is not None
        lines.append(
            f"  compiled, {N_CHECKED:,} observations: differs from onnxruntime by at most "
            f"{self.largest_error:.1e} of half the range"
        )
        lines.append(
            f"  one call on this machine: median {1e6 * self.median:.2f} us, worst of "
            f"{N_TIMED:,} {1e6 * self.worst:.1f} us (interruptions by the system included)"
        )
        return "\n".join(lines)


def export_c(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> Header:
    """
    Translate a file of :func:`~sb3_hds.deploy.export_onnx` to C99, for microcontrollers and control
    loops without Python. Where there is a command ``cc``, the header is compiled, compared with
    onnxruntime on 1,000 observations and timed before it is written.

    ``NAME_step(observation, ..., action)`` computes one action, where NAME is that of the header.
    Its memory, if any, is in a ``NAME_state`` that ``NAME_reset`` initialises. With
    ``-DNAME_MAIN``, in capitals, there is a ``main`` that reads observations, and joints if the
    policy reads some, from standard input and prints actions.

    :param source: the ONNX file
    :param path: of the header; an existing file is replaced
    :return: the header
    :raises ExportError: for an operation without a translation, or a header that disagrees with
        onnxruntime
    :raises ImportError: without the extra ``onnx``
    """
    try:
        import onnx
    except ImportError as error:
        raise ImportError(
            "Translating policies needs onnx: pip install 'sb3-hds[onnx]'."
        ) from error
    policy = OnnxPolicy(source)
    name = _identifier(Path(path).stem)
    shapes = {port: (1, *shape) for port, shape in policy._shapes.items()}
    translation = Translation(onnx.load(os.fspath(source)), shapes)
    text = _header(name, policy, translation, Path(source).name)
    header = Header(
        Path(path),
        len(text.encode()),
        translation.constant_bytes,
        translation.stack_bytes,
        translation.n_operations,
    )
    compiler = shutil.which("cc")
    if compiler is not None:
        error, median, worst = _checked(compiler, name, text, policy, translation)
        if not error <= TOLERANCE:
            raise ExportError(
                "The header would not compute what the file does: actions differ from onnxruntime "
                f"by {error:.1e} of half their range, and {TOLERANCE:g} is allowed. Nothing was "
                "written."
            )
        header = dataclasses.replace(header, largest_error=error, median=median, worst=worst)
    write_bytes(path, text.encode())
    return header


def _identifier(stem: str) -> str:
    """:raises ExportError: for a name that is no identifier in C"""
    found = re.sub(r"\W", "_", stem, flags=re.ASCII)
    if not re.match(r"[A-Za-z_]", found):
        raise ExportError(
            f"The name of a header becomes that of its functions, and '{stem}' is no name in C: "
            "begin it with a letter."
        )
    return found


def _header(name: str, policy: OnnxPolicy, translation: Translation, source: str) -> str:
    metadata, upper = policy.metadata, name.upper()
    memory = {part["input"]: part for part in metadata["memory"]}
    own = [port for port in translation.inputs if port not in memory]
    action = translation.outputs["action"]
    state = bool(memory)
    given = [f"const {translation.kind(port)} *{translation.symbol(port)}" for port in own]
    state_argument = [f"{name}_state *state"] if state else []
    arguments = ", ".join([*given, *state_argument, f"{translation.kind(action)} *action"])
    described = [
        f" *   {port}: {translation.size(port)} x {translation.kind(port)}"
        + _channels(metadata["observations"].get(port, ()))
        for port in own
    ]
    described.append(
        f" *   action: {translation.size(action)} x {translation.kind(action)}"
        + _channels(metadata["actions"])
    )
    lines = [
        f"/* {metadata['algorithm']}, from {source}, weights {metadata['weights_sha256'][:16]}.",
        f" * A step is {metadata['dt']} s long." if metadata["dt"] else " * The step is not known.",
        *described,
        f" * cc -std=c99 -O2 -D{upper}_MAIN -x c {name}.h -lm -o {name}",
        " */",
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "#include <math.h>",
        "",
        *(f"#define {upper}_N_{_identifier(p).upper()} {translation.size(p)}" for p in own),
        f"#define {upper}_N_ACTION {translation.size(action)}",
        "",
        *translation.constants(name),
        "",
    ]
    if state:
        lines += [
            "typedef struct {",
            *(f"    {translation.declared(port, port)}" for port in memory),
            f"}} {name}_state;",
            "",
            f"static void {name}_reset({name}_state *state) {{",
            *(
                f"    state->{port}[{i}] = {value!r};"
                for port, part in memory.items()
                for i, value in enumerate(map(float, part["initial"]))
            ),
            "}",
            "",
        ]
    lines += [f"static void {name}_step({arguments}) {{"]
    lines += [
        f"    const {translation.kind(port)} *{translation.symbol(port)} = state->{port};"
        for port in memory
    ]
    lines += [f"    {line}" for line in translation.body(name)]
    lines += [f"    {line}" for line in translation.copied(action, "action")]
    for port, part in memory.items():
        after = translation.outputs[part["output"]]
        lines += [f"    {line}" for line in translation.copied(after, f"state->{port}")]
    lines += ["}", "", *_main(name, translation, own, action, state), "#endif", ""]
    return "\n".join(lines)


def _channels(channels: Sequence[Mapping[str, Any]]) -> str:
    names = [f"{c['name']} [{c['unit']}]" if c.get("unit") else c["name"] for c in channels]
    text = f" ({', '.join(names)})" if names else ""
    return text.replace("*/", "* /")


def _main(
    name: str, translation: Translation, own: Sequence[str], action: str, state: bool
) -> list[str]:
    upper, is_integer = name.upper(), translation.kind(action) in ("int", "long long")
    symbols = [translation.symbol(port) for port in own]
    call = ", ".join([*symbols, *(["&state"] if state else []), "action"])
    printed = '"%lld%c", (long long)action[i]' if is_integer else '"%.9g%c", (double)action[i]'
    lines = [f"#ifdef {upper}_MAIN", "#include <stdio.h>", "", "int main(void) {"]
    lines += [f"    static {translation.declared(port)}" for port in own]
    lines += [f"    {translation.declared(action, 'action')}"]
    lines += [f"    {name}_state state;", f"    {name}_reset(&state);"] * state
    lines += ["    double number;", "    int i;", "    for (;;) {"]
    for port in own:
        symbol = translation.symbol(port)
        lines += [
            f"        for (i = 0; i < {translation.size(port)}; ++i) {{",
            '            if (scanf("%lf", &number) != 1) return 0;',
            f"            {symbol}[i] = ({translation.kind(port)})number;",
            "        }",
        ]
    n = translation.size(action)
    lines += [
        f"        {name}_step({call});",
        f"        for (i = 0; i < {n}; ++i)",
        f"            printf({printed}, i + 1 < {n} ? ' ' : '\\n');",
        "        fflush(stdout);",
        "    }",
        "}",
        f"#endif /* {upper}_MAIN */",
    ]
    return lines


def _checked(
    compiler: str, name: str, text: str, policy: OnnxPolicy, translation: Translation
) -> tuple[float, float, float]:
    """The largest error, and the median and the longest time of a call [s]."""
    rng = np.random.default_rng(0)
    memory = {part["input"] for part in policy.metadata["memory"]}
    own = [port for port in translation.inputs if port not in memory]
    rows = {port: _drawn(policy, port, rng) for port in own}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, f"{name}.h").write_text(text)
        _compile(compiler, folder, ["-x", "c", f"{name}.h", f"-D{name.upper()}_MAIN"], name)
        flat = np.concatenate([np.reshape(part, (N_CHECKED, -1)) for part in rows.values()], 1)
        given = "\n".join(" ".join(map(repr, row)) for row in flat.astype(float).tolist())
        found = _output([str(Path(folder, name))], given)
        found = np.array([list(map(float, line.split())) for line in found.splitlines()])
        Path(folder, "timed.c").write_text(_timed(name, translation, own, bool(memory)))
        _compile(compiler, folder, ["-D_POSIX_C_SOURCE=199309L", "timed.c"], "timed")
        median, worst = map(float, _output([str(Path(folder, "timed"))], "").split())
    wanted, state = [], None
    for k in range(N_CHECKED):
        now = {port: part[k] for port, part in rows.items()}
        parts = {key: now[port] for port, key in policy._keys.items()}
        observed = parts if all(parts) else next(iter(parts.values()))
        joints = (now["joint_position"], now["joint_velocity"]) if policy.joints else None
        action, state = policy.predict(observed, state, joints=joints)
        wanted.append(np.ravel(action))
    ends = [(a.get("low"), a.get("high")) for a in policy.metadata["actions"]]
    halves = np.array([1.0 if None in e else 0.5 * (e[1] - e[0]) for e in ends])
    differences = np.abs(found - np.array(wanted, float)) / halves
    return float(differences.max()), median, worst


def _drawn(policy: OnnxPolicy, port: str, rng: np.random.Generator) -> np.ndarray:
    shape = (N_CHECKED, *policy._shapes[port])
    if issubclass(policy._dtypes[port], np.integer):
        return rng.integers(0, 2, shape)
    return (2.0 * rng.standard_normal(shape)).astype(np.float32)


def _timed(name: str, translation: Translation, own: Sequence[str], state: bool) -> str:
    """A program that prints the median and the longest time of a call [s]."""
    symbols = [translation.symbol(port) for port in own]
    declared = "".join(f"    static {translation.declared(port)}\n" for port in own)
    action = translation.declared(translation.outputs["action"], "action")
    call = ", ".join([*symbols, *(["&state"] if state else []), "action"])
    return f"""#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "{name}.h"
static int compare(const void *a, const void *b) {{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}}
int main(void) {{
    static double seconds[{N_TIMED}];
{declared}    static {action}
    {f"{name}_state state; {name}_reset(&state);" if state else ""}
    struct timespec begin, end;
    int k;
    for (k = 0; k < {N_TIMED}; ++k) {{
        {symbols[0]}[0] = ({translation.kind(own[0])})(k % 2);
        clock_gettime(CLOCK_MONOTONIC, &begin);
        {name}_step({call});
        clock_gettime(CLOCK_MONOTONIC, &end);
        seconds[k] = (double)(end.tv_sec - begin.tv_sec);
        seconds[k] += 1e-9 * (double)(end.tv_nsec - begin.tv_nsec);
    }}
    qsort(seconds, {N_TIMED}, sizeof(double), compare);
    printf("%.9g %.9g\\n", seconds[{N_TIMED // 2}], seconds[{N_TIMED - 1}]);
    return 0;
}}
"""


def _compile(compiler: str, folder: str, arguments: Sequence[str], output: str) -> None:
    command = [compiler, *_FLAGS, *arguments, "-o", output, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise ExportError(f"The header does not compile:\n{done.stderr[:2000]}")


def _output(command: Sequence[str], given: str) -> str:
    return subprocess.run(command, input=given, capture_output=True, text=True, check=True).stdout
