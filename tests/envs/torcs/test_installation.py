"""What is refused as an installation of TORCS, and the command that installs it."""

import shutil

import pytest

from sb3_sap.cli.main import main
from sb3_sap.envs.torcs.installation import DATA, MODULES, TorcsNotFoundError, find_installation
from sb3_sap.envs.torcs.physics import Physics


def test_missing_installation_names_the_install_command(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("TORCS_ROOT", str(tmp_path))
    with pytest.raises(TorcsNotFoundError, match=r"no TORCS in TORCS_ROOT=.*sb3-sap torcs install"):
        find_installation()
    assert main(["torcs", "check"]) == 1
    assert "sb3-sap torcs install" in capsys.readouterr().err


def test_other_platforms_are_refused(monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(TorcsNotFoundError, match="on Linux on x86_64 alone, but this is linux on aarch64"):
        find_installation()


def test_other_versions_and_missing_files_are_refused(copy_of_torcs, monkeypatch):
    monkeypatch.setenv("TORCS_ROOT", str(copy_of_torcs.root))
    assert find_installation() == copy_of_torcs
    library = copy_of_torcs.root / MODULES["simu"]
    whole = library.read_bytes()
    library.write_bytes(whole + b"\0")
    with pytest.raises(TorcsNotFoundError, match=r"simuv2.so is not that of Debian's torcs 1.3.7"):
        find_installation()
    library.write_bytes(whole)
    (copy_of_torcs.root / MODULES["track"]).unlink()
    with pytest.raises(TorcsNotFoundError, match=r"track.so is missing"):
        find_installation()


def test_damaged_car_file_is_refused(copy_of_torcs):
    car = copy_of_torcs.car("car1-trb1")
    whole = car.read_text()
    car.write_text(whole[:5000])
    with pytest.raises(ValueError, match=r"not a readable TORCS car file"):
        Physics("g-track-3", installation=copy_of_torcs)
    car.write_text(whole.replace('name="category"', 'name="kategorie"'))
    with pytest.raises(ValueError, match="names no category"):
        Physics("g-track-3", installation=copy_of_torcs)


def test_damaged_surfaces_are_refused(copy_of_torcs):
    copy_of_torcs.surfaces().write_text("")
    with pytest.raises(ValueError, match=r"surfaces.xml, the road surfaces, is not the one"):
        Physics("g-track-3", installation=copy_of_torcs)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("apt-get") is None, reason="this is not Debian")
def test_install_command_installs_every_track(torcs, tmp_path, monkeypatch, capsys):
    root = tmp_path / "new"
    assert main(["torcs", "install", "--root", str(root)]) == 0
    assert "38 tracks" in " ".join(capsys.readouterr().out.split())
    kept = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
    assert kept < 10_000_000
    monkeypatch.setenv("TORCS_ROOT", str(root))
    assert find_installation().root == root
    assert (root / DATA).is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
