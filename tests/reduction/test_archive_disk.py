"""A reduced model on a full disk: one sentence, and what was there before stays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import softgrasp as sg
from softgrasp.fem.errors import ResourceError
from softgrasp.fem.resources import MARGIN

pytestmark = pytest.mark.serial


@pytest.mark.parametrize("room", [20_000, MARGIN + 30_000, MARGIN + 100_000])
def test_a_model_that_does_not_fit_is_refused(tmp_path: Path, small_files: Callable[[int], None], room: int) -> None:
    """In the small matrices, before the rows on the mesh, and in them: HDF5 by itself ends the program."""
    model = sg.build("paper_forward", ["tissue.cells=[12, 24]", "time.steps=60"])
    rom, file = sg.reduce(model, sg.simulate(model), N=40), tmp_path / "rom.h5"
    sg.save(rom, file)
    whole = file.read_bytes()
    assert len(whole) > 200_000
    small_files(room)
    with pytest.raises(ResourceError, match=r"rom\.h5 cannot be written \(File too large\); free the disk"):
        sg.save(rom, file)
    assert [path.name for path in tmp_path.iterdir()] == ["rom.h5"]
    assert file.read_bytes() == whole
