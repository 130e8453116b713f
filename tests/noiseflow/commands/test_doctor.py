"""`noiseflow doctor` tells what is there, what is missing and what does not work."""

import pytest

from noiseflow.commands import doctor
from noiseflow.commands.cli import main
from noiseflow.installation import install_command


def test_healthy_installation(run) -> None:
    result = run("doctor")
    assert result["healthy"]
    assert {"torch", "numpy", "mrcfile", "python", "noiseflow"} <= set(result["versions"])
    assert result["devices"][0].startswith("cpu")
    assert set(result["self_tests"]) >= {"noise-models", "reconstruction"}
    assert "formats" in result["extras"]
    assert all(folder != "nowhere" for folder in result["folders"].values()), result["folders"]


def test_missing_packages_come_with_the_line_that_installs_them(monkeypatch: pytest.MonkeyPatch, run) -> None:
    found = doctor.version_of
    monkeypatch.setattr(doctor, "version_of", lambda name: None if name == "rosettasciio" else found(name))
    monkeypatch.setattr(doctor, "run_self_tests", dict)
    formats = run("doctor")["extras"]["formats"]
    assert formats["missing"] == ["rosettasciio"]
    assert install_command("formats") in formats["advice"]


def test_failed_self_test_is_told_and_exits_with_1(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr("recon.projection.projector.SliceProjector.__call__", lambda self, volume: volume[:25] * 0)
    with pytest.raises(SystemExit) as stop:
        main(["doctor"])
    assert stop.value.code == 1
    assert "self-test reconstruction: ok" not in capsys.readouterr().out
