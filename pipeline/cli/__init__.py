"""The front door: what a person types.

Imports of weight stand inside the commands, so that ``gradetrace --help`` answers at once.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline import __version__
from pipeline.cli.calibrate import calibrate
from pipeline.cli.noise import noise
from pipeline.cli.options import JOBS, LOG, MACHINE, RUNS, SITE, print_table, usable_cores
from pipeline.cli.plan import plan
from pipeline.cli.survey import survey
from pipeline.errors import EXIT_BAD_INPUT, EXIT_OK, EXIT_PARTIAL_LOG, EXIT_VERDICT_FAIL, PipelineError

if TYPE_CHECKING:
    from pipeline.stages.job import Job

EXIT_INTERRUPTED = 130


class FrontDoor(click.Group):
    """Turns a fault of the input into one line and an exit code; a defect of ours keeps its traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except PipelineError as error:
            for line in str(error).splitlines():
                click.echo(f"gradetrace: {line}", err=True)
            sys.exit(error.exit_code)
        except KeyboardInterrupt:
            click.echo("gradetrace: interrupted; the same command goes on where this one stopped", err=True)
            sys.exit(EXIT_INTERRUPTED)


@click.group(cls=FrontDoor, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="gradetrace")
def main() -> None:
    """Turn the log of an excavator's cameras into poses and a trench report."""


main.add_command(calibrate)
main.add_command(plan)
main.add_command(noise)
main.add_command(survey)


@main.command()
@LOG
@MACHINE
@SITE
@RUNS
@click.option(
    "--strict", is_flag=True, help="End with 4 if the verdict is FAIL, 5 if part of the log is lost."
)
@JOBS
def report(
    log: Path, machine: Path | None, site: Path | None, runs: Path, strict: bool, jobs: int | None
) -> None:
    """Run what is stale and write the report of LOG.

    A second run does no work; a change to a setting redoes only the stages that use it; a run that was
    killed goes on where it was. With --strict a verdict of FAIL counts for more than a loss.
    """
    from pipeline.progress import watch_on
    from pipeline.stages.job import open_job
    from pipeline.stages.runner import run_stale

    job = open_job(
        log, machine, site, runs, workers=jobs or usable_cores(), strict=strict, create_folder=True
    )
    _say_sources(job)
    page = job.folder.file("report.html")
    with job.folder.locked():
        try:
            run_stale(job, watch_on())
        except PipelineError as error:
            if page.exists():
                raise type(error)(
                    f"{error}\n{page} is of an earlier run and does not show this one"
                ) from error
            raise
        verdict, complete = _outcome(job)
    click.echo(f"report: {page} · verdict {verdict}")
    if strict and verdict == "FAIL":
        sys.exit(EXIT_VERDICT_FAIL)
    if strict and not complete:
        sys.exit(EXIT_PARTIAL_LOG)
    sys.exit(EXIT_OK)


@main.command()
@LOG
@MACHINE
@SITE
@RUNS
def status(log: Path, machine: Path | None, site: Path | None, runs: Path) -> None:
    """Say what is done for LOG, what is stale, and why."""
    from pipeline.progress import count_words
    from pipeline.stages.job import open_job
    from pipeline.stages.runner import states

    job = open_job(log, machine, site, runs)
    _say_sources(job)
    rows: list[tuple[str, ...]] = []
    for state in states(job):
        if state.why is None:
            word = "✓ fresh"
        elif state.manifest is None:
            word = "· missing"
        else:
            word = "! stale"
        counts = ", ".join(count_words(state.manifest.counts)) if state.manifest else ""
        seconds = f"{state.manifest.seconds:.1f}" if state.manifest else ""
        rows.append((state.stage.name, word, seconds, state.why or counts))
    print_table(("stage", "state", "seconds", ""), rows)
    click.echo(f"run folder: {job.folder.path}")


@main.command()
@LOG
@MACHINE
@SITE
def check(log: Path, machine: Path | None, site: Path | None) -> None:
    """Say in a few seconds whether LOG is fit for a report, and if not, what to do.

    Ends with 3 if there is an error.
    """
    from pipeline.preflight import examine

    findings = examine(log, machine, site)
    symbols = {"ok": "✓", "warning": "!", "error": "✗"}
    for finding in findings:
        click.echo(f"{symbols[finding.level]} {finding.level + ':':<9}{finding.sentence}")
    errors = sum(finding.level == "error" for finding in findings)
    warnings = sum(finding.level == "warning" for finding in findings)
    if errors:
        click.echo(
            f"{log} is not fit for a report: {_plural(errors, 'error')}, {_plural(warnings, 'warning')}"
        )
        sys.exit(EXIT_BAD_INPUT)
    click.echo(f"{log} is fit for a report: no error, {_plural(warnings, 'warning')}")


@main.command()
@click.argument("a", metavar="A", type=click.Path(path_type=Path))
@click.argument("b", metavar="B", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON instead of a table.")
def diff(a: Path, b: Path, as_json: bool) -> None:
    """Compare two reports of one job, station by station: B minus A.

    A and B are run folders (runs/LOG) or report.json files: of two days, or of one log with another calibration.
    Ends with 3 where they are not of one job.
    """
    from pipeline.report.difference import as_dict, compare_reports, sentences, table_of
    from pipeline.report.report_file import read_report

    found = compare_reports(read_report(a), read_report(b))
    if as_json:
        from pipeline.runs import json_bytes

        click.echo(json_bytes(as_dict(found)).decode("utf-8"), nl=False)
        return
    for name, report in (("A", found.a), ("B", found.b)):
        log = report.files.get("log", ("unknown", ""))[0]
        click.echo(f"{name}: {report.source}, log {log}, verdict {report.verdict}")
    print_table(*table_of(found))
    for line in sentences(found):
        click.echo(line)


@main.command()
@click.argument("machine", metavar="MACHINE", type=click.Path(path_type=Path))
@click.argument("site", metavar="SITE", type=click.Path(path_type=Path))
@click.option(
    "--log",
    "run",
    metavar="RUN",
    type=click.Path(path_type=Path, file_okay=False),
    help="Run folder of a log (runs/LOG): draw what was seen in it.",
)
@click.option(
    "--out",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("network.svg"),
    show_default=True,
    help="Where the picture goes.",
)
def network(machine: Path, site: Path, run: Path | None, out: Path) -> None:
    """Draw which camera sees which marker, what hangs on what, and say what is not tied to the datum.

    MACHINE and SITE are machine.toml and site.toml. Without a log the picture shows what could be seen.
    """
    from pipeline.stages.network import draw, graph_of_files

    graph = graph_of_files(machine, site, run)
    for line in draw(graph, f"Network of {machine}" + (f", log {run.name}" if run else ""), out):
        click.echo(line)
    click.echo(f"drawn: {out}")


@main.command("sample-logs", context_settings={"ignore_unknown_options": True}, add_help_option=False)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def sample_logs(arguments: tuple[str, ...]) -> None:
    """Render logs of a site whose truth is known."""
    from pipeline.synthetic.__main__ import main as render

    render(list(arguments))


def _say_sources(job: Job) -> None:
    for source in (job.machine_source, job.site_source):
        where = {
            "option": "as given",
            "beside the log": "beside the log",
            "attachment": "attachment of the log",
        }[source.origin]
        click.echo(f"{source.name}: {where}, sha256 {source.sha256[:12]}")


def _outcome(job: Job) -> tuple[str, bool]:
    """The verdict, and whether the log was read whole."""
    import json

    verdict = str(job.counts("report").get("verdict", "unknown"))
    recovery = json.loads(job.folder.file("log.json").read_text(encoding="utf-8")).get("recovery", {})
    return verdict, bool(recovery.get("complete", True))


def _plural(number: int, noun: str) -> str:
    return f"{number or 'no'} {noun}" + ("" if number == 1 else "s")


if __name__ == "__main__":
    main()
