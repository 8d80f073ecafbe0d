r"""Observers of runs: plugins that receive the events of a run, such as one that sends a message when it has ended.

An observer is a function that returns a context in which it listens:

    @register_observer("bell", help="Ring the bell of the terminal when the run has ended.")
    @contextmanager
    def bell(values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
        def take(event: Event) -> None:
            if isinstance(event, RunFinished) and event.out == run.out:
                print("\a", end="", file=sys.stderr)

        yield take

`pano-mvs run --bell` switches it on. It receives the events of `pano_mvs.session.progress` in the thread of the run, so
that it should not take long. An error that it raises ends it with a warning, and the run goes on. Its context is closed
after the last event of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.doors import Door, RunOption
from pano_mvs.core.errors import PanoMvsError, PluginError
from pano_mvs.core.text import error_summary
from pano_mvs.engine.running.events import Warned
from pano_mvs.results.summary import INTERRUPTED
from pano_mvs.session.progress import Event, Progress, RunFinished


@dataclass(frozen=True, slots=True)
class ObservedRun:
    """The run that an observer observes."""

    out: Path  # its output folder; blocks of a large capture are runs with folders of their own
    warn: Callable[[str], None]  # adds a warning to the run, in one line


MakeObserver = Callable[[tuple[str, ...], ObservedRun], AbstractContextManager[Progress]]


@dataclass(frozen=True, slots=True)
class ObserverKind:
    """An observer that an option of `pano-mvs run` switches on."""

    make: MakeObserver
    help: str  # of its option
    metavar: str = ""  # what the value of its option is; empty for a flag

    def option(self, name: str) -> RunOption:
        """Return its option."""
        return RunOption(name, self.help, self.metavar, multiple=bool(self.metavar))


OBSERVERS = Door[ObserverKind](
    "observer",
    "pano_mvs.observers",
    accepts=lambda value: value if isinstance(value, ObserverKind) else None,
)


def register_observer(name: str, *, help: str, metavar: str = "") -> Callable[[MakeObserver], MakeObserver]:  # noqa: A002
    """Return a decorator that registers a function as the observer that `pano-mvs run --NAME` switches on.

    Args:
        help: of the option.
        metavar: what the value of the option is, such as `URL`; it may then be given more than once. Empty for a flag.
    """

    def register(make: MakeObserver) -> MakeObserver:
        OBSERVERS.register(name, ObserverKind(make, help, metavar), make)
        return make

    return register


def observer_options() -> dict[str, RunOption]:
    """Return the options that observers add to `pano-mvs run`, by name; plugins that cannot be loaded have none."""
    found: dict[str, RunOption] = {}
    for name in OBSERVERS.names():
        try:
            found[name] = OBSERVERS.get(name).option(name)
        except PluginError:
            continue
    return found


@dataclass
class Observers:
    """The observers of a run."""

    out: Path
    _listening: dict[str, Progress] = field(default_factory=dict)  # by name
    _warnings: list[str] = field(default_factory=list)  # that were not passed on yet
    _contexts: dict[str, ExitStack] = field(default_factory=dict)  # of those that listen, by name
    _has_ended: bool = False  # whether they have received the last event of the run

    def beside(self, progress: Progress) -> Progress:
        """Return a callback that passes events on, and to the observers; these receive the last event first."""

        def report(event: Event) -> None:
            if isinstance(event, RunFinished):
                try:
                    self._take(event, progress)
                finally:
                    progress(event)
            else:
                progress(event)
                self._take(event, progress)

        return report if self._listening else progress

    def start(self, name: str, values: Sequence[str]) -> None:
        """Let an observer listen; see `observing`."""
        context, run = ExitStack(), ObservedRun(self.out, self._warnings.append)
        make = OBSERVERS.get(name).make
        try:
            take = context.enter_context(make(tuple(values), run))
        except (PanoMvsError, KeyboardInterrupt):
            raise
        except BaseException as error:  # also others than Exception, as a plugin's code may raise
            raise PluginError(
                f"the observer {name} ({OBSERVERS.origin(name)}) cannot start: {error_summary(error)}"
            ) from error
        self._listening[name], self._contexts[name] = take, context

    def end(self, error: BaseException | None = None) -> None:
        """Close the observers; those of a run that an error kept from beginning learn of it first."""
        if error is not None and not self._has_ended:
            code = error.exit_code if isinstance(error, PanoMvsError) else 1
            text, code = ("interrupted", INTERRUPTED) if isinstance(error, KeyboardInterrupt) else (str(error), code)
            self._take(RunFinished(code, text, out=self.out), lambda _: None)
        for name in list(self._listening):
            self._close(name)

    def _take(self, event: Event, progress: Progress) -> None:
        self._has_ended |= isinstance(event, RunFinished) and event.out == self.out
        for name, take in list(self._listening.items()):
            try:
                take(event)
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                self._warn(name, error)
                with suppress(Exception):  # the first error is the one to report
                    self._forget(name)
            else:
                if self._has_ended:
                    self._close(name)
        while self._warnings:
            progress(Warned(self._warnings.pop(0)))

    def _close(self, name: str) -> None:
        try:
            self._forget(name)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            self._warn(name, error)

    def _forget(self, name: str) -> None:
        del self._listening[name]
        if name in self._contexts:
            self._contexts.pop(name).close()

    def _warn(self, name: str, error: BaseException) -> None:
        place = f"{name} ({OBSERVERS.origin(name)})"
        self._warnings.append(f"the observer {place} failed, and receives nothing more: {error_summary(error)}")


@contextmanager
def observing(wanted: Mapping[str, Sequence[str]], out: Path) -> Iterator[Observers]:
    """Let observers listen in this context; they learn of its end in any case.

    Args:
        wanted: name of each observer to the values of its option, () for a flag.
        out: the output folder of the run.

    Raises:
        UsageError: if there is no such observer, or it does not accept its values.
        PluginError: if one cannot be loaded, or fails to start.
    """
    observers = Observers(out)
    try:
        for name, values in wanted.items():
            observers.start(name, values)
        yield observers
    except BaseException as error:
        observers.end(error)
        raise
    else:
        observers.end()
