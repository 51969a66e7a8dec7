"""`ssmail import-data`: anyone's recorded agents as an expert set."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssmail.errors import InputError
from ssmail_cli.datasets import Force
from ssmail_cli.options import Json
from ssmail_cli.output import note, print_table, say, write_json

if TYPE_CHECKING:
    from ssmail.data.importing.summary import Summary
    from ssmail.data.trajectories import ExpertSet

PRESENT = "{0}, if there is such a column"
SAME = "the same ones in all scenes, by their names; if they are not, import with --no-same-agents"
DIFFERENT = "not the same ones in all scenes"
BY_FILE = "scene, else each file is a scene"

SceneColumn = Annotated[
    str | None, typer.Option("--scene", help="Column with the name of the scene.", show_default=BY_FILE)
]
FrameColumn = Annotated[
    str | None, typer.Option("--frame", help="Column with the number of the frame.", show_default="frame")
]
AgentColumn = Annotated[
    str | None, typer.Option("--agent", help="Column with the name of the agent.", show_default="agent")
]
XColumn = Annotated[str | None, typer.Option("--x", help="Column with the first coordinate.", show_default="x")]
YColumn = Annotated[
    str | None,
    typer.Option("--y", help="Column with the second coordinate; '' for none.", show_default=PRESENT.format("y")),
]
ZColumn = Annotated[
    str | None,
    typer.Option("--z", help="Column with the third coordinate; '' for none.", show_default=PRESENT.format("z")),
]
StepSeconds = Annotated[
    float | None,
    typer.Option("--dt", help="Seconds of a step; with it, --frame may be a column of times.", show_default=False),
]


def import_data(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE...", help="CSV, Parquet, .npy or .npz files, or folders that contain some."),
    ],
    out: Annotated[Path, typer.Option("--out", help="The .npz file to write.")] = Path("data/trajectories.npz"),
    scene: SceneColumn = None,
    frame: FrameColumn = None,
    agent: AgentColumn = None,
    x: XColumn = None,
    y: YColumn = None,
    z: ZColumn = None,
    dt: StepSeconds = None,
    window: Annotated[int, typer.Option("--window", min=2, help="Frames of a window.")] = 50,
    observed: Annotated[
        int | None,
        typer.Option("--observed", min=1, help="Frames of a window that a forecast is given.", show_default="half"),
    ] = None,
    stride: Annotated[
        int | None,
        typer.Option(
            "--stride", min=1, help="Frames from one window to the next.", show_default="those that are not observed"
        ),
    ] = None,
    fill_gaps: Annotated[
        int, typer.Option("--fill-gaps", min=0, help="Interpolate up to so many missing frames of an agent in a row.")
    ] = 0,
    agents: Annotated[
        int | None,
        typer.Option(
            "--agents", min=1, help="Most agents of a window: those nearest to one another.", show_default="all"
        ),
    ] = None,
    least_agents: Annotated[int, typer.Option("--least-agents", min=1, help="Fewest agents of a window.")] = 1,
    split: Annotated[
        str, typer.Option("--split", help="Shares of training, validation and test, split by scene.")
    ] = "70/15/15",
    validation: Annotated[
        list[str] | None,
        typer.Option("--validation", "--val", help="Instead of --split: name or pattern of scenes, repeatable."),
    ] = None,
    test: Annotated[
        list[str] | None, typer.Option("--test", help="With --validation: scenes to test on; the rest is trained on.")
    ] = None,
    same_agents: Annotated[
        bool | None,
        typer.Option(
            "--same-agents/--no-same-agents",
            help="Whether row n of all windows is the same agent, so that models may tell agents apart.",
            show_default="by the agents' names",
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Import your own trajectories as an expert set.

    A table has one row per agent and frame; an array has the axes (scenes, frames, agents, 1 to 3 coordinates). The
    scenes are cut into windows of the agents that are present throughout, and each scene belongs to one of the splits.
    Prints what came in and what was left out. Train on it with --env trajectories --set data.path=FILE.
    """
    from ssmail.data import expert_sets
    from ssmail.data.importing.dataset import ImportOptions, import_set
    from ssmail.data.importing.tables import Columns

    options = ImportOptions(
        columns=Columns(scene, frame, agent, x, y, z),
        dt=seconds(dt),
        window=window,
        observed=observed,
        stride=stride,
        fill_gaps=fill_gaps,
        least_agents=least_agents,
        most_agents=agents,
        split=_shares(split),
        validation=tuple(validation or ()),
        test=tuple(test or ()),
        same_agents=same_agents,
    )
    if out.suffix.lower() != ".npz":
        raise InputError(f"--out {out} does not end in .npz, as the name of an expert set does; choose another")
    expert_sets.check_target(out, force=force)
    experts, summary = import_set(sources, options, note, out)
    expert_sets.save(experts, out, force=force)
    _print_summary(experts, summary, out, as_json)


def seconds(dt: float | None) -> float | None:
    """Return the value of --dt. Raises InputError for one that is not positive, or out of range."""
    if dt is not None and not 1e-9 <= dt <= 1e9:
        raise InputError(f"--dt takes the seconds of a step, not {dt:g}; give a positive number")
    return dt


def _shares(text: str) -> tuple[int, int, int]:
    found = re.fullmatch(r"([1-9]\d{0,3})/([1-9]\d{0,3})/([1-9]\d{0,3})", text, re.ASCII)
    if not found:
        raise InputError(f"--split takes three shares such as 70/15/15, not {text[:40]!r}; none may be 0")
    train, validation, test = map(int, found.groups())
    return train, validation, test


def _print_summary(experts: "ExpertSet", summary: "Summary", out: Path, as_json: bool) -> None:
    """Print what came in, and on stderr what may be a mistake."""
    if as_json:
        write_json(
            {
                "path": out,
                "hash": experts.hash,
                "files": summary.files,
                "rows": summary.rows,
                "scenes": summary.scenes,
                "splits": summary.splits,
                "same_agents": summary.same_agents,
                "speeds": summary.speeds,
                "left_out": summary.left_out,
                "remarks": summary.remarks,
                "parameters": experts.parameters,
                "sources": experts.sources,
            },
            None,
        )
    else:
        print_table(
            [
                {
                    "split": split,
                    **counts,
                    "agents": f"{counts['least_agents']}-{counts['most_agents']}",
                }
                for split, counts in summary.splits.items()
            ],
            {"split": "split", "scenes": "scenes", "windows": "windows", "agents": "agents"},
        )
        unit = "second" if experts.parameters["dt"] else "step"
        speeds = ", ".join(f"{name} {value:.4g}" for name, value in summary.speeds.items())
        files = "1 file" if summary.files == 1 else f"{summary.files:,} files"
        say(f"read {summary.rows:,} rows of {summary.scenes:,} scenes from {files}")
        say(f"speeds in units per {unit}: {speeds}")
        say(f"agents: {SAME if summary.same_agents else DIFFERENT}")
        for what, count in summary.left_out.items():
            if count:
                say(f"{what}: {count:,}")
        say(f"wrote {out}: hash {experts.hash[:16]}")
    for remark in summary.remarks:
        note(f"note: {remark}")
