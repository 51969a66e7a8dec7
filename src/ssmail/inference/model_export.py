"""Export a trained model: weights, spec, model card, and one step as a standalone program."""

import io
import json
import logging
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from ssmail import __version__
from ssmail.data.atomic_file import atomic_write
from ssmail.errors import InputError, missing_package
from ssmail.inference.step_programs import Program, step_programs
from ssmail.inference.trained_run import TrainedRun
from ssmail.models import message_passing

FORMAT = 1
"""Version of model.json."""
_METRIC = re.compile(r"[\w./-]{1,80}", re.ASCII)


def export(
    run: TrainedRun,
    folder: Path,
    *,
    agents: int | None = None,
    batch: int = 1,
    onnx: bool = True,
    force: bool = False,
) -> list[str]:
    """Write the folder of an exported model, and return the names of its files. See `step_programs` for the programs.

    Raises InputError if the folder is not empty and `force` is off, if it cannot be written, if there is no model, or
    if a package of the extra `export` is missing.
    """
    try:
        from safetensors.torch import save as save_tensors

        if onnx:
            import onnxscript  # noqa: F401
    except ImportError as error:
        raise missing_package(error, "export") from None
    _check_folder(folder, force)
    programs = step_programs(run, agents, batch)
    described = _described(run, programs, onnx)
    state = {name: value.contiguous() for name, value in run.predictor.model.state_dict().items()}
    files = {
        "README.md": _card(run, programs, described, batch, onnx).encode(),
        "model.json": _json(described),
        "spec.json": _json(run.spec.model_dump(mode="json")),
        "weights.safetensors": save_tensors(state),
    }
    for name, program in programs.items():
        files |= {f"{name}{ending}": content for ending, content in _compiled(program, onnx).items()}
    try:
        for name, content in files.items():
            with atomic_write(folder / name) as partial:
                partial.write_bytes(content)
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror or error}; choose another --out") from error
    return sorted(files)


def _check_folder(folder: Path, force: bool) -> None:
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder} is no folder; choose another --out")
        if folder.exists() and any(folder.iterdir()) and not force:
            raise InputError(f"{folder} is not empty; choose another --out, or write into it with --force")
    except OSError as error:
        raise InputError(f"{folder} cannot be used: {error.strerror}; choose another --out") from None


def _compiled(program: Program, onnx: bool) -> dict[str, bytes]:
    """Return the program for torch.export (.pt2) and, if asked for, as ONNX (.onnx).

    The networks are traced in their readable form, which has no gradients of its own.
    """
    arguments = tuple(value.clone() for value in program.inputs.values())  # one tensor in two places would be one input
    contents = {}
    with _readable_form(), torch.no_grad(), _quiet():
        traced = torch.export.export(program.module.eval(), arguments)
        written = io.BytesIO()
        torch.export.save(traced, written)
        contents[".pt2"] = written.getvalue()
        if onnx:
            names: dict[str, Any] = {"input_names": list(program.inputs), "output_names": list(program.outputs)}
            made = torch.onnx.export(traced, (), None, dynamo=True, external_data=False, verbose=False, **names)
            assert made is not None
            contents[".onnx"] = made.model_proto.SerializeToString()
    return contents


@contextmanager
def _readable_form() -> Iterator[None]:
    before, message_passing.FAST = message_passing.FAST, False
    try:
        yield
    finally:
        message_passing.FAST = before


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out what torch's exporters print about themselves."""
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(logging.NOTSET)


def _described(run: TrainedRun, programs: Mapping[str, Program], onnx: bool) -> dict[str, Any]:
    """Return the contents of model.json."""
    return {
        "format": FORMAT,
        "ssmail": __version__,
        "run": run.id,
        "seed": run.seed,
        "spec_hash": run.spec_hash,
        "data_sha256": run.dataset_hash,
        "model": run.model,
        "epoch": run.epoch,
        "axes": run.axes,
        "agents": run.agents,
        "scaling": asdict(run.scaling),
        "programs": {
            name: {
                "files": [f"{name}.pt2", *([f"{name}.onnx"] if onnx else [])],
                "inputs": {
                    key: {"shape": list(value.shape), "meaning": program.meanings.get(key, "")}
                    for key, value in program.inputs.items()
                },
                "outputs": list(program.outputs),
            }
            for name, program in programs.items()
        },
        "metrics": {name: value for name, value in run.metrics.items() if _METRIC.fullmatch(name)},
    }


def _card(
    run: TrainedRun, programs: Mapping[str, Program], described: Mapping[str, Any], batch: int, onnx: bool
) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("ssmail.inference"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # Markdown; what a database may hold is checked in `_described`
    )
    metrics = {name: value for name, value in described["metrics"].items() if name.startswith(("test", "best_epoch"))}
    return environment.get_template("model_card.md.j2").render(
        run=run,
        version=__version__,
        spec_hash=_word(run.spec_hash),
        data_sha256=_word(run.dataset_hash or "unknown"),
        profile=_word(run.spec.profile),
        format=FORMAT,
        programs=programs,
        agents=programs["step"].inputs["positions"].shape[1],
        batch=batch,
        onnx=onnx,
        steps=run.predicted,
        metrics=metrics,
    )


def _word(text: str) -> str:
    """Return a text of the database as a word that Markdown shows as it is."""
    return re.sub(r"[^\w-]", "?", text, flags=re.ASCII)[:64]


def _json(value: Any) -> bytes:
    """Return JSON; NaN and infinities become null."""
    return (json.dumps(_finite(value), indent=2) + "\n").encode()


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
