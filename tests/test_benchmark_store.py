"""Results are single files while a grid is made, and are packed into one archive without losing a byte."""

import lzma
import shutil
from pathlib import Path

import pytest

from sb3_sap.benchmark import store
from sb3_sap.benchmark.configurations import parse_configuration, parse_configurations
from sb3_sap.benchmark.runs import make_grid, make_run
from sb3_sap.benchmark.store import pack, read_archive, read_result, run_path, write_result
from sb3_sap.cli.main import main

RESULTS = Path(__file__).parent.parent / "results"


def run(text="ddpg", steps=100, seed=0):
    return make_run(parse_configuration(text), "highway", steps, seed, ["g-track-3"])


def result(of, value=0.1):
    return {"run": of.description(), "laps": {"columns": ["score"], "data": [[value]]}}


@pytest.fixture
def folder(tmp_path):
    """Three results of single files."""
    for seed in (10, 9, 1):
        write_result(run(seed=seed), tmp_path, result(run(seed=seed)))
    return tmp_path


def files(folder):
    return sorted(path.name for path in (folder / "runs").iterdir())


# ---------------------------------------------------------------- which result belongs to a run


def test_a_result_is_found_by_its_whole_description(tmp_path):
    here = run()
    write_result(here, tmp_path, result(here))
    assert read_result(here, tmp_path) == result(here)
    for other in (run(seed=1), run(steps=101), run("ddpg[gamma=0.9]"), run("ddpg[env.speed=60]")):
        assert read_result(other, tmp_path) is None
    write_result(here, tmp_path, {"run": here.description() | {"steps": 99}})
    assert read_result(here, tmp_path) is None


def test_a_new_parameter_leaves_results_valid_and_a_changed_default_does_not(tmp_path):
    here = make_run(parse_configuration("ddpg_ap:default"), "torcs", 300, 0)
    older = {name: value for name, value in here.defaults.items() if name != "alpha_low"}
    written = {"run": here.description() | {"defaults": older}}
    write_result(here, tmp_path, written)
    assert read_result(here, tmp_path) == written
    write_result(here, tmp_path, {"run": here.description() | {"defaults": older | {"alpha": 0.8}}})
    assert read_result(here, tmp_path) is None


@pytest.mark.parametrize("text", ['{"run": ', "[]\n", '{"laps": {}}\n', '{"run": {}}\n', '{"run":\n{}}\n', ""])
def test_a_damaged_file_is_reported_in_one_sentence(text, tmp_path):
    path = run_path(run().name, tmp_path)
    path.parent.mkdir()
    path.write_text(text)
    for read in (lambda: read_result(run(), tmp_path), lambda: pack(tmp_path)):
        with pytest.raises(ValueError, match=r"is not the result of a run .*: delete it to make it again") as error:
            read()
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)
    assert files(tmp_path) == [path.name]
    assert not (tmp_path / store.ARCHIVE).exists()


# ---------------------------------------------------------------- packing


def test_the_archive_is_the_files_one_after_another(folder):
    lines = [run_path(run(seed=seed).name, folder).read_bytes() for seed in (1, 10, 9)]  # sorted by name
    assert pack(folder) == (3, 3)
    assert lzma.decompress((folder / store.ARCHIVE).read_bytes()) == b"".join(lines)
    assert files(folder) == []
    assert [read_result(run(seed=seed), folder) == result(run(seed=seed)) for seed in (1, 9, 10)] == [True] * 3
    assert read_result(run(seed=2), folder) is None


def test_the_same_runs_give_the_same_bytes(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    for seed in (1, 9, 10):  # in another order, and packed one by one
        write_result(run(seed=seed), other, result(run(seed=seed)))
        pack(other)
    pack(folder)
    assert (folder / store.ARCHIVE).read_bytes() == (other / store.ARCHIVE).read_bytes()


def test_a_file_takes_precedence_over_the_archive_and_replaces_its_line(folder):
    pack(folder)
    write_result(run(seed=9), folder, result(run(seed=9), 0.2))
    assert read_result(run(seed=9), folder) == result(run(seed=9), 0.2)
    assert pack(folder) == (1, 3)
    assert read_result(run(seed=9), folder) == result(run(seed=9), 0.2)
    assert read_result(run(seed=1), folder) == result(run(seed=1), 0.1)


class Killed(BaseException):
    """Stands for the end of the process, which no handler sees."""


@pytest.mark.parametrize("step", ["write", "delete"])
def test_a_kill_while_packing_loses_nothing(step, folder, monkeypatch):
    write_result(run(seed=2), folder, result(run(seed=2)))
    pack(folder)
    for seed in (2, 3, 4):
        write_result(run(seed=seed), folder, result(run(seed=seed), seed))

    def killed(*args):
        raise Killed

    expected = {seed: result(run(seed=seed), seed if seed in (2, 3, 4) else 0.1) for seed in (1, 2, 3, 4, 9, 10)}
    with monkeypatch.context() as patched:
        if step == "write":
            patched.setattr(store.os, "fsync", killed)
        else:
            unlink, deleted = Path.unlink, []
            patched.setattr(Path, "unlink", lambda path: killed() if deleted else deleted.append(unlink(path)))
        with pytest.raises(Killed):
            pack(folder)
    remaining = 3 if step == "write" else 2
    assert len(files(folder)) == remaining
    assert {seed: read_result(run(seed=seed), folder) for seed in expected} == expected
    assert pack(folder) == (remaining, 6)
    assert files(folder) == []
    assert {seed: read_result(run(seed=seed), folder) for seed in expected} == expected


def test_a_run_that_is_made_again_while_packing_remains(folder, monkeypatch):
    again, write = run(seed=1), store._write_archive

    def write_slowly(*args):
        write(*args)
        write_result(again, folder, result(again, 0.3))  # by another process

    monkeypatch.setattr(store, "_write_archive", write_slowly)
    pack(folder)
    assert files(folder) == [f"{again.name}.json"]
    assert read_result(again, folder) == result(again, 0.3)


def test_a_file_under_the_name_of_another_run_is_refused(folder):
    shutil.copy(run_path(run(seed=1).name, folder), run_path(run(seed=2).name, folder))
    with pytest.raises(ValueError, match="holds the result of another run than its name says: delete it"):
        pack(folder)
    assert len(files(folder)) == 4


@pytest.mark.parametrize(
    "damage",
    [
        lambda archive: archive[:-20],
        lambda archive: b"not xz at all",
        lambda archive: archive[:60] + b"\0" + archive[61:],
        lambda archive: lzma.compress(b'{"run": 1}\n'),
        lambda archive: lzma.compress(b"\xff\n"),
        lambda archive: lzma.compress(lzma.decompress(archive)[:-5]),
    ],
)
def test_a_damaged_archive_is_reported_in_one_sentence(damage, folder):
    pack(folder)
    path = folder / store.ARCHIVE
    path.write_bytes(damaged := damage(path.read_bytes()))
    write_result(run(seed=2), folder, result(run(seed=2)))
    for read in (lambda: read_result(run(seed=1), folder), lambda: pack(folder)):
        with pytest.raises(ValueError, match=r"is not an archive of results .*: restore it, or delete it") as error:
            read()
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)
    assert path.read_bytes() == damaged
    assert files(folder) == [f"{run(seed=2).name}.json"]


def test_an_archive_is_read_once_until_it_is_replaced(folder, monkeypatch):
    pack(folder)
    opened, open_archive = [], lzma.open

    def count(*args, **kwargs):
        opened.append(args)
        return open_archive(*args, **kwargs)

    monkeypatch.setattr(store.lzma, "open", count)
    for seed in (1, 9, 10, 2):
        read_result(run(seed=seed), folder)
    assert len(opened) == 1
    write_result(run(seed=2), folder, result(run(seed=2)))
    pack(folder)
    assert read_result(run(seed=2), folder) == result(run(seed=2))
    assert read_result(run(seed=1), folder) == result(run(seed=1))
    assert len(opened) == 2


def test_the_command_packs_every_grid(tmp_path, capsys):
    for name in ("highway-100", "highway-200"):
        write_result(run(), tmp_path / name, result(run()))
    (tmp_path / "a_page.md").touch()
    assert main(["benchmark", "pack", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("holds 1 runs, 1 of which were packed now") == 2
    assert read_result(run(), tmp_path / "highway-200") == result(run())
    assert main(["benchmark", "pack", "--out", str(tmp_path)]) == 0
    assert "there are no runs to pack" in capsys.readouterr().out


# ---------------------------------------------------------------- what is committed


def test_every_committed_archive_is_sorted_and_holds_each_run_once():
    archives = sorted(RESULTS.glob(f"*/{store.ARCHIVE}"))
    assert len(archives) >= 11
    for path in archives:
        names = list(read_archive(path.parent))
        assert names == sorted(names)
        assert len(names) == lzma.decompress(path.read_bytes()).count(b"\n")


def test_committed_results_are_those_of_todays_settings():
    """Otherwise the benchmark would make the runs of the paper's table again."""
    grid = make_grid(parse_configurations(["paper"]), "torcs", 3_000, range(10))
    runs = [run for runs in grid.values() for run in runs]
    assert [run.name for run in runs if read_result(run, RESULTS / "torcs-3000") is None] == []
