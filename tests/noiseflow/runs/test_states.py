"""What is written of a run's state comes back, takes no more room than it must, and a damaged file is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.numpy import load_file
from torch.testing import assert_close

from noiseflow.runs.run_folder import _packed, discard_states, read_state, write_state


def test_nested_values_come_back_as_they_were(tmp_path: Path) -> None:
    state: dict[str, Any] = {
        "numbers": [1, 2.5, True, None, "word"],
        "inner": {"tensor": torch.arange(6).view(2, 3), "list": [{"deep": torch.ones(())}, []]},
        "empty": {},
        "half": torch.tensor([0.5, -1.0], dtype=torch.float16),
        "flags": torch.tensor([True, False]),
    }
    write_state(tmp_path / "state.safetensors", state)
    found = read_state(tmp_path / "state.safetensors")
    assert found["numbers"] == state["numbers"]
    assert [type(each) for each in found["numbers"]] == [int, float, bool, type(None), str]
    assert found["empty"] == {}
    assert found["inner"]["list"][1] == []
    for name in ("half", "flags"):
        assert torch.equal(found[name], state[name])
        assert found[name].dtype == state[name].dtype
    assert torch.equal(found["inner"]["tensor"], state["inner"]["tensor"])
    assert_close(found["inner"]["list"][0]["deep"], torch.ones(()))


def test_views_are_written_alone_and_whole_tensors_without_a_copy_of_their_storage(tmp_path: Path) -> None:
    large = torch.arange(1000.0)
    shared = torch.ones(50)
    state = {
        "view": large[3:7],
        "other": large[10:13],
        "column": large.view(10, 100)[:, 1],
        "one": shared,
        "same": shared,
        "half": shared[:25],
    }
    write_state(tmp_path / "state.safetensors", state)
    found = read_state(tmp_path / "state.safetensors")
    for name, value in state.items():
        assert torch.equal(found[name], value)
    stored = load_file(tmp_path / "state.safetensors")
    assert sum(each.size for each in stored.values()) == 4 + 3 + 10 + 50 + 50 + 25
    assert (tmp_path / "state.safetensors").stat().st_size < 2000
    tensors: dict[str, torch.Tensor] = {}
    _packed([shared, large], tensors)
    assert [each.data_ptr() for each in tensors.values()] == [shared.data_ptr(), large.data_ptr()]


def test_what_a_state_cannot_hold_and_what_is_no_state_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="cannot hold set"):
        write_state(tmp_path / "state.safetensors", {"a": {1}})
    assert not list(tmp_path.iterdir())
    (tmp_path / "state.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0 nothing of ours")
    with pytest.raises(ValueError, match="is damaged"):
        read_state(tmp_path / "state.safetensors")


def test_discarding_takes_states_and_named_files_and_an_empty_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    discard_states(folder)
    folder.mkdir()
    write_state(folder / "a.safetensors", {"a": 1})
    (folder / "run.json").write_text("{}")
    (folder / "mine.txt").write_text("kept")
    discard_states(folder, "run.json", "never.json")
    assert [file.name for file in folder.iterdir()] == ["mine.txt"]
    (folder / "mine.txt").unlink()
    write_state(folder / "b.safetensors", {"a": 1})
    discard_states(folder, "run.json")
    assert not folder.exists()
