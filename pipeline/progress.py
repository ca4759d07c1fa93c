"""What a person sees while the stages run: bars on a terminal, plain lines anywhere else."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from pipeline.runs import NEVER_RUN

if TYPE_CHECKING:
    from rich.console import Console

    from pipeline.runs import Manifest
    from pipeline.stages import Stage
    from pipeline.stages.job import Progress
    from pipeline.stages.runner import Watch

PLAIN_LINE_EVERY_S = 10.0
"""Often enough to see that a log of a whole shift moves, seldom enough for a CI log."""


def watch_on(stream: TextIO | None = None) -> Watch:
    """The watch that fits where the output goes: bars on a terminal, else lines without control codes."""
    stream = sys.stdout if stream is None else stream
    if stream.isatty():
        from rich.console import Console

        console = Console(file=stream, highlight=False, markup=False, emoji=False, soft_wrap=True)
        if console.is_terminal and not console.is_dumb_terminal:
            return TerminalWatch(console)
    return PlainWatch(stream)


class PlainWatch:
    """Lines of text: one when a stage ends, and some on the way of a long one."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    @contextmanager
    def stage(self, stage: Stage, why: str) -> Iterator[Progress]:
        self._line(start_line(stage, why))
        yield PlainProgress(stage.name, self._line)

    def done(self, stage: Stage, manifest: Manifest, ran: bool) -> None:
        self._line(end_line(stage, manifest, ran))
        if not ran:
            for sentence in manifest.warnings:
                self._line(warning_line(stage.name, sentence))

    def _line(self, text: str) -> None:
        self._stream.write(text + "\n")
        self._stream.flush()


class PlainProgress:
    """Says how far a stage is about every ten seconds."""

    def __init__(self, stage: str, line: Any, clock: Any = time.monotonic):
        self._stage, self._line, self._clock = stage, line, clock
        self._amount, self._done, self._unit = 0.0, 0.0, ""
        self._started = self._last = clock()

    def total(self, amount: float, unit: str = "") -> None:
        self._amount, self._done, self._unit = amount, 0.0, unit
        self._started = self._last = self._clock()

    def advance(self, amount: float = 1) -> None:
        self._done += amount
        now = self._clock()
        if now - self._last < PLAIN_LINE_EVERY_S or self._amount <= 0 or self._done >= self._amount:
            return
        self._last = now
        rate = self._done / (now - self._started)
        left = (self._amount - self._done) / rate if rate > 0 else float("inf")
        self._line(
            f"{self._stage}: {self._done:,.0f} of {self._amount:,.0f} {self._unit}".rstrip()
            + f" ({100 * self._done / self._amount:.0f} %), about {duration(left)} left"
        )

    def warn(self, sentence: str) -> None:
        self._line(warning_line(self._stage, sentence))


class TerminalWatch:
    """A bar per stage, replaced by its line when the stage ends."""

    def __init__(self, console: Console):
        self._console = console

    @contextmanager
    def stage(self, stage: Stage, why: str) -> Iterator[Progress]:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TaskProgressColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=30, complete_style="cyan", finished_style="cyan", pulse_style="cyan"),
            TaskProgressColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[unit]}"),
            TimeElapsedColumn(),
            TextColumn("· left"),
            # From the speed of the last minute: frames at the start of a shift say little about those at its end.
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            speed_estimate_period=60,
        )
        with bar:
            task = bar.add_task(start_line(stage, why), total=None, unit="")
            yield TerminalProgress(stage.name, bar, task)

    def done(self, stage: Stage, manifest: Manifest, ran: bool) -> None:
        self._console.print(end_line(stage, manifest, ran))
        if not ran:
            for sentence in manifest.warnings:
                self._console.print(warning_line(stage.name, sentence), style="yellow")


class TerminalProgress:
    def __init__(self, stage: str, bar: Any, task: Any):
        self._stage, self._bar, self._task = stage, bar, task

    def total(self, amount: float, unit: str = "") -> None:
        self._bar.reset(self._task, total=amount, unit=unit)

    def advance(self, amount: float = 1) -> None:
        self._bar.advance(self._task, amount)

    def warn(self, sentence: str) -> None:
        self._bar.console.print(warning_line(self._stage, sentence), style="yellow")


class Silence:
    """Progress nobody looks at; keeps the warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def total(self, amount: float, unit: str = "") -> None:
        pass

    def advance(self, amount: float = 1) -> None:
        pass

    def warn(self, sentence: str) -> None:
        self.warnings.append(sentence)


def start_line(stage: Stage, why: str) -> str:
    """What is said when a stage starts: what it does, and why again where it was done before."""
    return f"{stage.name}: {stage.doing}" + ("" if why == NEVER_RUN else f" ({why})")


def end_line(stage: Stage, manifest: Manifest, ran: bool) -> str:
    """What is said when a stage ends: ``detect: 860 frames, 41 rejected (border 3, low margin 38), 13.1 s``."""
    if ran:
        return f"{stage.name}: " + ", ".join([*count_words(manifest.counts), f"{manifest.seconds:.1f} s"])
    return f"{stage.name}: up to date ({', '.join(count_words(manifest.counts))})".replace(" ()", "")


def warning_line(stage: str, sentence: str) -> str:
    return f"{stage}: warning: {sentence}"


def count_words(counts: dict[str, Any]) -> list[str]:
    """Counts as people read them: "7,312 tags accepted", "verdict PASS", "41 rejected (border 3, low margin 38)"."""
    words = []
    for word, value in counts.items():
        if not value and len(counts) > 1:
            continue  # a line of noughts hides what matters; the manifest keeps them
        if isinstance(value, dict):
            reasons = [
                f"{reason} {number:,}"
                for reason, number in sorted(value.items(), key=lambda item: (-item[1], item[0]))
                if number
            ]
            total = sum(value.values())
            if not total:
                continue
            words.append(f"{total:,} {word}" + (f" ({', '.join(reasons)})" if reasons else ""))
        elif isinstance(value, bool) or not isinstance(value, int | float):
            words.append(f"{word} {value}")
        elif isinstance(value, int):
            words.append(f"{value:,} {word}")
        else:
            words.append(f"{word} {value:.3g}")
    return words


def duration(seconds: float) -> str:
    """Seconds as people say them: 45 s, 12 min, 1 h 20 min."""
    if not seconds < 1e7:
        return "an unknown time"
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
