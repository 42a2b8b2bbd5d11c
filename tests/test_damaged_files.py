"""Saved models, policies and replay buffers that were damaged: seeded, thirty of each."""

import io
import json
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
from small_models import NAMES, same, saved, small

from sb3_hds import algos, load_policy

pytestmark = pytest.mark.usefixtures("quick_compilation")
N = 30
QUICK = ("hds", "droq", "openloop")
some_algorithms = pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.expensive) for name in NAMES],
)


def cut(content: bytearray, rng: np.random.Generator) -> None:
    del content[rng.integers(len(content)) :]


def flip_bits(content: bytearray, rng: np.random.Generator) -> None:
    for at in rng.integers(len(content), size=rng.integers(1, 9)):
        content[at] ^= 1 << int(rng.integers(8))


def overwrite(content: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(content)))
    content[at : at + 100] = rng.bytes(len(content[at : at + 100]))


def leave_out(content: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(content)))
    del content[at : at + int(rng.integers(1, 200))]


def put_in(content: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(content)))
    content[at:at] = rng.bytes(int(rng.integers(1, 200)))


def change_the_end(content: bytearray, rng: np.random.Generator) -> None:
    """Where a zip file has its directory."""
    for at in rng.integers(max(0, len(content) - 1_000), len(content), size=3):
        content[at] = int(rng.integers(256))


DAMAGES = (cut, flip_bits, overwrite, leave_out, put_in, change_the_end)


def damaged(content: bytes, n: int = N):
    """:return: n of its damaged versions, one after the other, each in a file"""
    rng = np.random.default_rng(0)
    for i in range(n):
        now = bytearray(content)
        DAMAGES[i % len(DAMAGES)](now, rng)
        yield io.BytesIO(now)


def repacked(content: bytes, part: str, change: Callable[[bytes], bytes]) -> io.BytesIO:
    """:return: a zip file of which one part was changed before it was packed"""
    with zipfile.ZipFile(io.BytesIO(content)) as old:
        parts = {name: old.read(name) for name in old.namelist()}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as new:
        for name, its in parts.items():
            new.writestr(name, change(its) if name == part else its)
    file.seek(0)
    return file


def told(read: Callable[[], object], what: str = "damaged") -> tuple[object, bool]:
    """:return: what was read, or that an error told in one line what it is"""
    try:
        return read(), False
    except ValueError as error:
        assert type(error) is ValueError and what in str(error), repr(error)
        assert "\n" not in str(error)
        return None, True


def content_of(write: Callable[[io.BytesIO], None]) -> bytes:
    file = io.BytesIO()
    write(file)
    return file.getvalue()


@some_algorithms
def test_a_damaged_model_says_so_in_one_line_or_is_what_was_saved(name):
    model, n_told = small(name), 0
    expected, content = model.get_parameters(), saved(model).getvalue()

    for file in damaged(content):
        loaded, was_told = told(lambda file=file: algos.ALL[name].load(file))
        assert was_told or same(expected, loaded.get_parameters())
        file.seek(0)
        policy, _ = told(lambda file=file: load_policy(file))
        assert policy is None or same({"": model.policy.state_dict()}, {"": policy.state_dict()})
        file.seek(0)
        told(lambda file=file: model.set_parameters(file))
        assert same(expected, model.get_parameters())
        n_told += was_told
    assert n_told > 0.9 * N


@some_algorithms
def test_a_damaged_policy_says_so_in_one_line_or_is_what_was_saved(name):
    policy = small(name).policy
    expected = policy.state_dict()

    for file in damaged(content_of(policy.save)):
        loaded, _ = told(lambda file=file: type(policy).load(file))
        assert loaded is None or same({"": expected}, {"": loaded.state_dict()})


@some_algorithms
@pytest.mark.parametrize("part", ["data", "policy.pth"])
def test_what_a_stranger_packed_is_a_policy_or_an_error_in_one_line(name, part, no_pickle):
    content = saved(small(name)).getvalue()
    data = json.loads(zipfile.ZipFile(io.BytesIO(content)).read("data"))
    # Most of the data are pickles, of which nothing is read.
    description = json.dumps({"policy_description": data["policy_description"]}).encode()
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        inside = description if part == "data" else archive.read(part)

    for file in damaged(inside):
        strange = repacked(content, part, lambda _, file=file: file.getvalue())
        told(lambda strange=strange: load_policy(strange), what="")


def test_data_that_are_nested_too_deep_are_an_error_in_one_line():
    deep = repacked(saved(small("droq")).getvalue(), "data", lambda _: b"[" * 200_000)

    assert told(lambda: load_policy(deep))[1]


def test_a_damaged_replay_buffer_says_so_and_the_one_of_before_stays():
    model = small("droq").learn(20)
    content, before = content_of(model.save_replay_buffer), model.replay_buffer

    for file in damaged(content):
        _, was_told = told(lambda file=file: model.load_replay_buffer(file))
        assert not was_told or model.replay_buffer is before
        model.replay_buffer = before


def test_files_that_are_not_there_or_something_else_are_named(tmp_path):
    (tmp_path / "notes.zip").write_text("no model")
    with zipfile.ZipFile(tmp_path / "pictures.zip", "w") as pictures:
        pictures.writestr("one.png", b"")

    for read in (load_policy, algos.ALL["droq"].load, small("droq").set_parameters):
        with pytest.raises(FileNotFoundError, match="nowhere"):
            read(tmp_path / "nowhere")
        with pytest.raises(ValueError, match=r"notes.*is damaged, or is no saved model"):
            read(tmp_path / "notes")
        with pytest.raises(ValueError, match=r"pictures.*is no saved model \(no '"):
            read(tmp_path / "pictures.zip")
