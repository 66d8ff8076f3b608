"""``sb3-sap plot``: rl_zoo3's plots, into files on request, and the report of a study."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from sb3_sap.common.errors import nearest
from sb3_sap.zoo.arguments import command_line
from sb3_sap.zoo.storages import load_study
from sb3_sap.zoo.study_report import write_report_to

PLOTS = ("train", "all", "file", "study")


def plot(command: str, arguments: list[str]) -> None:
    """Runs ``plot WHAT``."""
    del command
    if not arguments or arguments[0] not in PLOTS:
        raise ValueError(f"`plot` needs to know what: {nearest(arguments[0] if arguments else '', PLOTS)}")
    what, rest = arguments[0], arguments[1:]
    parser = ArgumentParser(prog=f"sb3-sap plot {what}", add_help=what == "study", allow_abbrev=False)
    if what == "study":
        parser.add_argument("--storage", required=True, help="where the study is kept")
        parser.add_argument("--study-name", required=True, help="its name")
        parser.add_argument("--out", type=Path, default=Path("report"), help="folder of the report")
        options = parser.parse_args(rest)
        print(f"The report is in {write_report_to(load_study(options.storage, options.study_name), options.out)}")
        return
    parser.add_argument("--save-figures", type=Path, metavar="FOLDER", help="write the figures as PNG, open no window")
    own, rest = parser.parse_known_args(rest)
    if {"-h", "--help"} & set(rest):
        parser.print_help()
    _rl_zoo3_plot(what, rest, own.save_figures)


def _rl_zoo3_plot(what: str, arguments: list[str], folder: Path | None) -> None:
    import matplotlib

    if folder:
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from rl_zoo3.plots import all_plots, plot_from_file, plot_train

    from sb3_sap.evaluation.plots import save

    if folder:
        plt.show = lambda *args, **kwargs: None
    with command_line(f"plot {what}", arguments):
        plots: dict[str, Any] = {"train": plot_train, "all": all_plots, "file": plot_from_file}
        plots[what]()
    for number in plt.get_fignums() if folder else []:
        save(plt.figure(number), folder / f"{what}_{number}.png")  # type: ignore[operator]
