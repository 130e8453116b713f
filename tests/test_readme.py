"""The README's Python blocks run as they stand, on real data."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from noiseflow import io

README = Path(__file__).parent.parent / "README.md"


@pytest.mark.slow
def test_python_blocks_of_the_readme_run(tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(data / "exposures_miro" / "channel1_050ms.tif", "short.tif")
    shutil.copy(data / "exposures_miro" / "channel1_long.tif", "long.tif")
    io.write("clean.tif", np.linspace(110, 250, 4096, dtype=np.float32).reshape(64, 64))
    needle = io.read(data / "tilt_needle" / "needle_aligned.mrc")
    io.write("tilts.mrc", needle.data[:, 20:36], voxel_size=needle.voxel_size)
    shutil.copy(data / "tilt_needle" / "needle_aligned.rawtlt", "tilts.rawtlt")
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) == 3
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
    assert io.read("volume.mrc").data.shape == (64, 16, 64)
    assert io.read("volume.mrc").voxel_size == pytest.approx(needle.voxel_size)
