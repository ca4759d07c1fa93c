"""One job: a log, its two descriptions, the files they name, and the run folder; what a stage is handed."""

from __future__ import annotations

import hashlib
import json
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pipeline import tables
from pipeline.config import Machine, Site, load_machine, load_site
from pipeline.config.document import decode, read_file
from pipeline.config.quantities import FAMILIES, dictionary_of
from pipeline.errors import ArtefactError, ConfigError, LogError, UsageError
from pipeline.runs import RunFolder, atomic_write, json_bytes
from pipeline.stages import Stage, stage_named

Counts = dict[str, Any]
"""Word -> number, or word -> {reason: number}; in the order in which they are printed."""


class Progress(Protocol):
    """What a stage tells of its work while it runs; `pipeline.progress` shows it to people."""

    def total(self, amount: float, unit: str = "") -> None:
        """How much there is to do; `unit` is a plural noun, for example "frames"."""

    def advance(self, amount: float = 1) -> None:
        """So much more has been done."""

    def warn(self, sentence: str) -> None:
        """A sentence that a person should read though the stage goes on."""


MAX_NAMED_FILE_BYTES = 200_000_000
"""A design surface of a large site has some 50 MB; more is a mistake or an attack."""


@dataclass(frozen=True)
class Source:
    """Where a description came from."""

    name: str
    """`machine.toml` or `site.toml`, or how the option named it."""
    origin: str
    """`option`, `beside the log` or `attachment`."""
    sha256: str
    folder: Path
    """Folder in which the files that it names are looked up."""

    def facts(self) -> dict[str, str]:
        """For manifests and the report: without folders, so that the same job gives the same bytes anywhere."""
        return {"name": self.name, "origin": self.origin, "sha256": self.sha256}


@dataclass(frozen=True)
class NamedFile:
    """A file that site.toml names."""

    path: Path
    name: str
    """As site.toml writes it."""
    sha256: str


@dataclass(frozen=True)
class Job:
    """What a stage is handed; see `pipeline.stages` for what it does with it."""

    log: Path
    log_sha256: str
    folder: RunFolder
    machine: Machine
    site: Site
    machine_source: Source
    site_source: Source
    files: dict[str, NamedFile]
    """`design`, `checks` if the site has check shots, `utilities.<name>` for each that is read from a file."""
    workers: int = 1
    strict: bool = False
    stage: Stage | None = None
    """The stage that runs; set by the runner."""
    fingerprint: str = ""
    """Of the stage that runs."""
    written: list[str] = field(default_factory=list)
    """Outputs of the stage so far, relative to the run folder."""

    def at(self, stage: Stage, fingerprint: str) -> Job:
        """This job as one stage sees it."""
        return replace(self, stage=stage, fingerprint=fingerprint, written=[])

    @property
    def scratch(self) -> Path:
        """Folder for finished pieces of this stage; gone when the stage is done or its fingerprint is another."""
        assert self.stage is not None
        return self.folder.scratch(self.stage.name, self.fingerprint)

    def read_table(
        self,
        name: str,
        columns: list[str] | None = None,
        part: str | None = None,
        at_ns: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Columns of a table that an earlier stage wrote, of some instants only if asked. Raises ArtefactError."""
        self._may_read(next((s for s in self._needs() if name in stage_named(s).tables), None), name)
        return tables.read_table(self.folder.file(table_file(name, part)), name, columns, at_ns)

    def parts(self, name: str) -> list[str]:
        """The parts of a table that comes in several files, for example the cameras of `detections`."""
        found = []
        for stage in self._needs():
            manifest = self.folder.manifest(stage)
            for output in manifest.outputs if manifest else ():
                if output.startswith(f"{name}/") and output.endswith(".parquet"):
                    found.append(output.removeprefix(f"{name}/").removesuffix(".parquet"))
        return sorted(found)

    def read_json(self, file: str) -> Any:
        """Content of a JSON file that an earlier stage wrote. Raises ArtefactError."""
        try:
            return json.loads(self.folder.file(file).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ArtefactError(
                f"{self.folder.file(file)} is missing or damaged ({error}); run 'gradetrace report' again to make it"
            ) from None

    def write_table(
        self,
        name: str,
        columns: tables.Columns,
        part: str | None = None,
        metadata: dict[str, str] | None = None,
    ) -> None:
        """Write a table of this stage; see `pipeline.tables.write_table`."""
        tables.write_table(self._output(table_file(name, part)), name, columns, metadata)

    def table_writer(
        self, name: str, part: str | None = None, metadata: dict[str, str] | None = None
    ) -> AbstractContextManager[tables.TableWriter]:
        """Write a table of this stage in portions; see `pipeline.tables.table_writer`."""
        return tables.table_writer(self._output(table_file(name, part)), name, metadata)

    def write_json(self, file: str, value: Any) -> None:
        """Write a JSON file of this stage; NaN becomes null, numpy arrays become lists."""
        atomic_write(self._output(file), json_bytes(value))

    def write_bytes(self, file: str, data: bytes) -> None:
        """Write any other file of this stage."""
        atomic_write(self._output(file), data)

    def counts(self, stage: str) -> Counts:
        """What an earlier stage counted."""
        manifest = self.folder.manifest(stage)
        return manifest.counts if manifest else {}

    def warnings(self, stage: str) -> list[str]:
        """What an earlier stage warned of."""
        manifest = self.folder.manifest(stage)
        return manifest.warnings if manifest else []

    def calibrated_machine(self) -> Machine:
        """The machine with every camera's intrinsics: those left out of machine.toml come from the log.

        Raises ConfigError when a camera has them nowhere.
        """
        return self.machine.with_calibrations(
            self.read_json("log.json").get("calibrations", {}), self.machine_source.name
        )

    def _needs(self) -> tuple[str, ...]:
        assert self.stage is not None
        return (*self.stage.needs, self.stage.name)

    def _may_read(self, owner: str | None, name: str) -> None:
        # An undeclared dependency would let a stale result pass as fresh.
        assert owner is not None, (
            f"stage {self.stage and self.stage.name} reads {name} without needing its stage"
        )

    def _output(self, file: str) -> Path:
        if file not in self.written:
            self.written.append(file)
        return self.folder.file(file)


def table_file(name: str, part: str | None = None) -> str:
    """File of a table in the run folder."""
    return f"{name}.parquet" if part is None else f"{name}/{part}.parquet"


def describe(
    log: Path,
    machine: Path | None = None,
    site: Path | None = None,
    attachments: dict[str, bytes] | None = None,
) -> tuple[Machine, Source, Site, Source]:
    """The machine and the site of a log: as given, else beside the log, else from the log's attachments.

    `attachments` are read from the log when they are needed and not given.
    Raises ConfigError, LogError, UsageError.
    """
    machine_data, machine_name, machine_source = _description(log, "machine.toml", machine, attachments)
    site_data, site_name, site_source = _description(log, "site.toml", site, attachments)
    read_machine = load_machine(decode(machine_data, machine_name), machine_name)
    read_site = load_site(decode(site_data, site_name), site_name)
    _refuse_parts_of_one_dictionary(read_machine, read_site)
    return read_machine, machine_source, read_site, site_source


def _refuse_parts_of_one_dictionary(machine: Machine, site: Site) -> None:
    # Tag 7 of DICT_4X4_50 is tag 7 of DICT_4X4_100: each would be found twice, and two markers might share it unseen.
    first: dict[str, tuple[str, str]] = {}
    marks = [(f"markers.{name}", mark.family) for name, mark in machine.markers.items()]
    marks += [(f"benchmarks.{name}", mark.family) for name, mark in site.benchmarks.items()]
    for name, family in marks:
        other, named = first.setdefault(dictionary_of(family), (name, family))
        if named != family:
            larger = max(named, family, key=FAMILIES.__getitem__)
            raise ConfigError(
                f"{other} has tags of {named} and {name} of {family}, which is the same dictionary with more or fewer "
                f"tags; write {larger} for both, the ids stay"
            )


def _description(
    log: Path, kind: str, option: Path | None, attachments: dict[str, bytes] | None
) -> tuple[bytes, str, Source]:
    """Bytes of a description, how messages call it, and its source."""
    if option is not None and not option.is_file():
        raise UsageError(f"--{kind.removesuffix('.toml')} {option}: no such file")
    beside = log.parent / kind
    if option is not None or beside.is_file():
        path = option or beside
        data, name, origin, folder = read_file(path), str(path), "beside the log", path.parent
        if option is not None:
            origin = "option"
    else:
        data = _attached(_attachments(log) if attachments is None else attachments, kind, log)
        name, origin, folder = f"{kind} (attachment of {log.name})", "attachment", log.parent
    sha256 = hashlib.sha256(data).hexdigest()
    return data, name, Source(option.name if option else kind, origin, sha256, folder)


def _attachments(log: Path) -> dict[str, bytes]:
    from pipeline.logs.reader import read_log

    with read_log(log) as reader:
        return reader.attachments()


def _attached(attachments: dict[str, bytes], kind: str, log: Path) -> bytes:
    if kind not in attachments:
        raise ConfigError(
            f"no {kind} for {log}: there is none beside the log and the log carries none as an attachment; "
            f"put one beside the log, or name it with --{kind.removesuffix('.toml')}"
        )
    return attachments[kind]


def named_files(site: Site, source: Source, folder: RunFolder) -> dict[str, NamedFile]:
    """The files that site.toml names, hashed. Raises ConfigError where one is missing or lies elsewhere."""
    wanted = {"design": site.design.file} | ({"checks": site.checks.file} if site.checks else {})
    if site.ground is not None and site.ground.file is not None:
        wanted["ground"] = site.ground.file
    wanted |= {f"utilities.{name}": utility.file for name, utility in site.utilities.items() if utility.file}
    found = {}
    for key, name in wanted.items():
        path = resolve_named_file(source.folder, name, f"{source.name}: {key}.file")
        try:
            found[key] = NamedFile(path, name, folder.hash_file(path))
        except OSError as error:
            raise ConfigError(
                f"{source.name}: {key}.file: {path} cannot be read ({error.strerror})"
            ) from None
    return found


def resolve_named_file(folder: Path, name: str, where: str) -> Path:
    """The file called `name` in `folder`, and nowhere else.

    A site.toml travels inside logs that others recorded, so it must not reach files outside the folder it is in:
    no absolute path, no `..`, no link that leads out, no device. Raises ConfigError.
    """
    parts = Path(name).parts
    if not name or Path(name).is_absolute() or "\\" in name or ":" in name or "\0" in name or ".." in parts:
        raise ConfigError(
            f"{where} = '{name}': must be a file beside site.toml, without '..' or a path from the root; "
            "put the file there and write its name"
        )
    path = folder / name
    if not path.exists():
        raise ConfigError(f"{where} = '{name}': no such file in {folder}; put it there, or mend the name")
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ConfigError(
            f"{where} = '{name}': is a link that leads out of {folder}; put the file itself there"
        )
    if not path.is_file():
        raise ConfigError(f"{where} = '{name}': is not a file")
    if path.stat().st_size > MAX_NAMED_FILE_BYTES:
        raise ConfigError(
            f"{where} = '{name}': {path.stat().st_size / 1e6:.0f} MB, at most {MAX_NAMED_FILE_BYTES / 1e6:.0f} MB "
            "are read; cut it down to the job"
        )
    return path


def open_job(
    log: Path,
    machine: Path | None = None,
    site: Path | None = None,
    runs: Path = Path("runs"),
    workers: int = 1,
    strict: bool = False,
    create_folder: bool = False,
) -> Job:
    """The job of a log, everything that it names found, read and hashed.

    Raises
    ------
    LogError
        There is no such log, or it is empty or no MCAP file.
    ConfigError
        A description is missing or wrong, or a file it names cannot be used.
    """
    job = open_log(log, machine, site, RunFolder(runs / log.stem), workers, strict, create_folder)
    return replace(job, files=named_files(job.site, job.site_source, job.folder))


def open_log(
    log: Path,
    machine: Path | None,
    site: Path | None,
    folder: RunFolder,
    workers: int = 1,
    strict: bool = False,
    create_folder: bool = False,
) -> Job:
    """The same without the files that site.toml names: for who needs only what the log shows. Raises as `open_job`."""
    check_log_file(log)
    machine_model, machine_source, site_model, site_source = describe(log, machine, site)
    if create_folder:
        folder.create()
    return Job(
        log=log,
        log_sha256=folder.hash_file(log),
        folder=folder,
        machine=machine_model,
        site=site_model,
        machine_source=machine_source,
        site_source=site_source,
        files={},
        workers=workers,
        strict=strict,
    )


def check_log_file(log: Path) -> None:
    """Raise LogError unless `log` is a file that can be read and has content."""
    try:
        if not log.exists():
            raise LogError(f"{log}: no such file")
        if not log.is_file():
            raise LogError(f"{log}: is not a file; name one MCAP log")
        if log.stat().st_size == 0:
            raise LogError(
                f"{log}: is empty; the recorder wrote nothing, or the copy was cut off: copy it again"
            )
        with log.open("rb") as stream:
            stream.read(1)
    except OSError as error:
        raise LogError(f"{log}: cannot be read ({error.strerror})") from None
