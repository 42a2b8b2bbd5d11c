"""Saved models, policies and replay buffers that were damaged."""

import io
import json
import zipfile

import pytest
from damage import damaged
from small_models import repacked, same, saved, small

from sb3_hds import algos, load_policy

N = 18
#: one of each way to write a model; the others share every line with one of these
some_algorithms = pytest.mark.parametrize("name", ["hds", "droq", "openloop"])


def told(read, *arguments, what="damaged"):
    """:return: what was read, or that an error told in one line what it is"""
    try:
        return read(*arguments), False
    except ValueError as error:
        assert type(error) is ValueError and what in str(error), repr(error)
        assert "\n" not in str(error)
        return None, True


def content_of(write):
    file = io.BytesIO()
    write(file)
    return file.getvalue()


@some_algorithms
def test_a_damaged_model_says_so_in_one_line_or_is_what_was_saved(name):
    model, n_told = small(name), 0
    expected, content = model.get_parameters(), saved(model).getvalue()

    for broken in damaged(content, N):
        loaded, was_told = told(algos.ALL[name].load, io.BytesIO(broken))
        assert was_told or same(expected, loaded.get_parameters())
        policy, _ = told(load_policy, io.BytesIO(broken))
        assert policy is None or same({"": model.policy.state_dict()}, {"": policy.state_dict()})
        told(model.set_parameters, io.BytesIO(broken))
        assert same(expected, model.get_parameters())
        n_told += was_told
    assert n_told > 0.8 * N


@some_algorithms
def test_a_damaged_policy_says_so_in_one_line_or_is_what_was_saved(name):
    policy = small(name).policy
    expected = policy.state_dict()

    for broken in damaged(content_of(policy.save), N):
        loaded, _ = told(type(policy).load, io.BytesIO(broken))
        assert loaded is None or same({"": expected}, {"": loaded.state_dict()})


@some_algorithms
@pytest.mark.parametrize("part", ["data", "policy.pth"])
def test_what_a_stranger_packed_is_a_policy_or_an_error_in_one_line(name, part, no_pickle):
    model = small(name)
    with zipfile.ZipFile(saved(model)) as archive:
        inside = archive.read(part)
    if part == "data":
        # Most of the data are pickles, of which nothing is read.
        of_policy = {"policy_description": json.loads(inside)["policy_description"]}
        inside = json.dumps(of_policy).encode()

    for broken in damaged(inside, N):
        strange = repacked(model, part, lambda _, broken=broken: broken)
        told(load_policy, strange, what="")
    assert told(load_policy, repacked(model, "data", lambda _: b"[" * 200_000))[1]


def test_a_damaged_replay_buffer_says_so_and_the_one_of_before_stays():
    model = small("droq").learn(20)
    content, before = content_of(model.save_replay_buffer), model.replay_buffer

    for broken in damaged(content, N):
        _, was_told = told(model.load_replay_buffer, io.BytesIO(broken))
        assert not was_told or model.replay_buffer is before
        model.replay_buffer = before


def test_missing_files_and_files_of_another_kind_are_named(tmp_path):
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
