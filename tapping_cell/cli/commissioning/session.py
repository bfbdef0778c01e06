"""Commissioning session: its folder, its measurements, the dialogue with the person, and the
running nodes."""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from tapping_cell.cli.errors import ExitStatus
from tapping_cell.cli.graph import HARDWARE, SIMULATED, Graph, with_own_ports
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.durable_file import replace_text
from tapping_cell.nodes.clients.enabling_client import EnablingClient

RECORD = "commission.json"
REMEDY = "restore the file, or choose another folder with --out"
"""Remedy for a damaged record. Deleting the file is no remedy, because the folder may contain files
of a simulated session."""


class StepFailed(RuntimeError):
    """A step failed. The message contains the measurement and the remedy."""


@dataclass(frozen=True, slots=True)
class Proof:
    """Measurements of a step."""

    sentence: str
    values: Mapping[str, float | str] = field(default_factory=dict)
    """Values by name; the name ends in the unit, such as ``residual_mm``."""


@dataclass(slots=True)
class Session:
    """Commissioning session in one folder, either on hardware or simulated. The folder contains the
    cell's files (``config``) and the measurements (``commission.json``)."""

    folder: Path
    console: Console
    hardware: bool
    unattended: bool
    camera: str = ""
    seed: int = 1
    proofs: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def config(self) -> Path:
        """Folder of the cell's files."""
        return self.folder / "config"

    @property
    def cell_file(self) -> Path:
        """Cell file that the session creates."""
        return self.config / "cell.yaml"

    def cell(self) -> Cell:
        """Load the cell in its current configuration."""
        return load_cell(self.cell_file)

    # The record

    def load(self) -> None:
        """Load the completed steps from the folder, if it contains a session.

        Raises:
            ConfigurationError: the file is damaged, or the folder contains a simulated session, but
                this session is on hardware, or vice versa.
            OSError: the file cannot be read.
        """
        record = self.folder / RECORD
        if not record.exists():
            return
        try:
            content = json.loads(record.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ConfigurationError(f"{record}: is not JSON ({error}); {REMEDY}") from error
        if problem := _problem(content):
            raise ConfigurationError(f"{record}: {problem}; {REMEDY}")
        if self.hardware and not content["hardware"]:
            raise ConfigurationError(
                f"{self.folder} contains a simulated session, which does not verify the hardware; "
                f"choose another folder for the hardware, such as --out {self.folder}_hardware"
            )
        if content["hardware"] and not self.hardware:
            raise ConfigurationError(
                f"{self.folder} contains a session on hardware; give --hardware to continue it, or "
                f"choose another folder to simulate, such as --out {self.folder}_simulated"
            )
        self.proofs = content["steps"]

    def save(self) -> None:
        """Write the completed steps to the folder.

        Raises:
            OSError: the file cannot be written.
        """
        self._write(self.proofs)

    def _write(self, proofs: Mapping[str, Mapping[str, Any]]) -> None:
        content = {"hardware": self.hardware, "steps": proofs}
        replace_text(self.folder / RECORD, json.dumps(content, indent=1) + "\n")

    def prove(self, step: str, proof: Proof, seconds: float) -> None:
        """Store a step's measurements. Raises as :meth:`save`."""
        made = datetime.now().astimezone().isoformat(timespec="seconds")
        stored = {**asdict(proof), "seconds": round(seconds, 1), "made": made}
        proofs = {**self.proofs, step: stored}
        self._write(proofs)
        self.proofs = proofs

    def forget(self, step: str) -> None:
        """Delete a step's measurements, so that the step is repeated. Raises as :meth:`save`."""
        self.proofs.pop(step, None)
        self.save()
        self.recording(step).unlink(missing_ok=True)

    def recording(self, step: str) -> Path:
        """File in which a step records its measurements one by one. An interrupted recording is
        resumed."""
        return self.folder / f"{step}.csv"

    # The person

    def instruct(self, sentence: str) -> None:
        """Show an instruction and wait until the person confirms it. Do nothing in unattended
        mode."""
        if self.unattended:
            return
        self.console.print(f"[cyan]>[/] {escape(sentence)}")
        self._answer("  press Enter when this is done, or Ctrl-C to stop and continue later ")

    def ask(self, question: str, default: str) -> str:
        """Return a person's answer, or the default in unattended mode."""
        if self.unattended:
            return default
        self.console.print(f"[cyan]?[/] {escape(question)} \\[{escape(default)}]")
        return self._answer("  ").strip() or default

    def _answer(self, prompt: str) -> str:
        try:
            return self.console.input(prompt)
        except EOFError:
            raise StepFailed(
                "the standard input ended before an answer; run the command in a terminal"
                + ("" if self.hardware else ", or with --yes, which asks nothing")
            ) from None

    # Other verbs

    def verb(self, *arguments: str) -> dict[str, Any]:
        """Run a verb that prints one JSON object, and return this object.

        Raises:
            StepFailed: the verb failed; the message contains the verb's error message.
            KeyboardInterrupt: the verb was interrupted.
        """
        from tapping_cell.cli import main

        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = main(arguments)
            except SystemExit as ended:
                status = int(ended.code or 0)
        if status == ExitStatus.INTERRUPTED:
            raise KeyboardInterrupt
        if status:
            output = " ".join(err.getvalue().split()) or " ".join(out.getvalue().split())
            raise StepFailed(f"{' '.join(arguments[:2])} failed: {output.removeprefix('error: ')}")
        text = out.getvalue()
        found: dict[str, Any] = json.loads(text) if text.lstrip().startswith("{") else {}
        return found

    # The nodes

    @contextlib.contextmanager
    def running(
        self, set_up: bool = False, truth: Path | None = None, only_world: bool = False
    ) -> Iterator[Graph]:
        """Run the cell's nodes with the files of this session until the end of the block.

        ``truth``: simulation parameter file to use instead of the default. ``only_world``: start
        only ``sim_world``. Both arguments apply only to the simulated cell.
        """
        files = {"cell_file": self.cell_file}
        parameters: dict[str, dict[str, object]] = {
            "sim_world": {"seed": self.seed},
            "overhead_camera": {**files, "source": self.camera},
            "camera_pose": dict(files),
            "tap_planner": dict(files),
            "scara_arm": {**files, "set_up": set_up},
            "tapper_trigger": {**files, "set_up": set_up},
            "operator_page": {**files, "runs": self.folder / "runs"},
        }
        nodes: tuple[str, ...] = (*HARDWARE, "operator_page")
        if not self.hardware:
            nodes = ("sim_world",) if only_world else SIMULATED
            parameters = with_own_ports(parameters, self.ports)
            if truth is not None:
                parameters["sim_world"]["truth_file"] = truth
        with (
            Graph(nodes, parameters, self.folder / "logs") as graph,
            EnablingClient(held=set_up and not self.hardware),
        ):
            yield graph

    @property
    def ports(self) -> Path:
        """Folder of the simulated devices' ports."""
        return self.folder / "ports"


def _problem(content: Any) -> str:
    """Return what is wrong with the content of the record; empty if nothing is."""
    if not isinstance(content, Mapping):
        return "must be a mapping"
    if not isinstance(content.get("hardware"), bool):
        return "key 'hardware' must be true or false, but earlier versions did not write it"
    if not isinstance(content.get("steps"), Mapping):
        return "key 'steps' must be a mapping"
    kinds: dict[str, Any] = {
        "sentence": str,
        "values": Mapping,
        "seconds": (int, float),
        "made": str,
    }
    for step, proof in content["steps"].items():
        for key, kind in kinds.items():
            if not isinstance(proof, Mapping) or not isinstance(proof.get(key), kind):
                return f"key 'steps.{step}.{key}' is missing or of the wrong type"
    return ""


def wait(condition: Any, patience: float, what: str, graph: Graph) -> None:
    """Wait until a condition holds.

    Raises:
        StepFailed: the condition does not hold within ``patience`` s.
    """
    deadline = time.monotonic() + patience
    while not condition():
        graph.check()
        if time.monotonic() > deadline:
            raise StepFailed(f"waited {patience:.0f} s for {what}")
        time.sleep(0.05)
