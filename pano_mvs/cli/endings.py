"""End commands: print errors, or how to go on, and exit with the code that `core/errors.py` defines for each class."""

from __future__ import annotations

import inspect
import shlex
import sys
import traceback
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin

import typer
from rich.markup import escape
from typer.models import ArgumentInfo

from pano_mvs.cli.console import Console
from pano_mvs.core.doors import own_packages
from pano_mvs.core.errors import PanoMvsError, RunStoppedError, StoreError, WorkflowError
from pano_mvs.core.memory import require_address_space
from pano_mvs.core.paths import reason_of

Command = TypeVar("Command", bound=Callable[..., None])


def guarded(command: Command) -> Command:
    """Turn exceptions into messages and exit codes, and refuse empty arguments and empty paths of options."""

    @wraps(command)
    def run_guarded(*args: Any, **kwargs: Any) -> None:
        errors = Console(stderr=True)
        try:
            require_address_space()
            command(*args, **kwargs)
        except PanoMvsError as error:
            for problem in error.problems if isinstance(error, WorkflowError) else [str(error)]:
                errors.say(f"[red]error:[/] {escape(problem)}")
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            errors.print(
                "interrupted; finished results are kept. To continue, run the same command again:", highlight=False
            )
            errors.say(f"  {escape(shlex.join(['pano-mvs', *sys.argv[1:]]))}")
            raise typer.Exit(130) from None
        except typer.Exit:
            raise
        except SystemExit as end:  # a plugin's code; ours raises typer.Exit
            traceback.print_exc()
            errors.say(
                f"[red]error:[/] the code above called sys.exit({escape(str(end.code))}), which a plugin must not do; "
                "finished results are kept"
            )
            raise typer.Exit(1) from None
        except MemoryError:
            errors.say(
                "[red]error:[/] no memory is left, or a limit such as `ulimit -v` is reached; finished results are "
                "kept. Use fewer --workers or smaller images, or raise the limit, and run the same command again"
            )
            raise typer.Exit(RunStoppedError.exit_code) from None
        except Exception as error:
            if isinstance(error, OSError) and error.filename is not None:  # no more specific message exists
                problem = f"{error.filename}: {reason_of(error)}. Correct its permissions, or choose another path"
                errors.say(f"[red]error:[/] {escape(problem)}")
                raise typer.Exit(StoreError.exit_code) from None
            traceback.print_exc()
            module = command.__module__
            if module.partition(".")[0] in own_packages():
                errors.print("[red]internal error:[/] this is a bug in pano_mvs; finished results are kept")
            else:
                place = escape(getattr(sys.modules.get(module), "__file__", None) or module)
                errors.say(f"[red]error:[/] the command is one of a plugin, {place}, whose code failed; see above")
            raise typer.Exit(1) from None

    # Empty paths and arguments are errors: a variable of the shell without a value makes an empty one, and an empty
    # path is the current folder.
    signature = inspect.signature(command, eval_str=True)
    for parameter in signature.parameters.values():
        if get_origin(parameter.annotation) is not Annotated:
            continue
        hint, info, *_ = get_args(parameter.annotation)
        if Path in _leaves(hint) and not _is_checked(info):
            info.parser = path
        elif str in _leaves(hint) and isinstance(info, ArgumentInfo):
            info.parser = text
    run_guarded.__signature__ = signature  # type: ignore[attr-defined]
    return cast(Command, run_guarded)


def _is_checked(info: Any) -> bool:
    """Return whether a parameter of a plugin's command has checks of its own, which a parser would replace."""
    return any(getattr(info, name, None) for name in ("click_type", "exists", "resolve_path"))


def _leaves(hint: Any) -> list[Any]:
    return [leaf for part in get_args(hint) for leaf in _leaves(part)] or [hint]


# Some versions of typer show the names of these two in the help, as types.
def text(given: str) -> str:
    """Return an argument that is not empty."""
    if not given:
        raise typer.BadParameter("the name is empty")
    return given


def path(given: str) -> Path:
    """Return the path that an argument or an option states."""
    if "\0" in str(given):
        raise typer.BadParameter("a path cannot hold a null byte")
    return Path(text(given))


_ENDINGS = {
    0: "finished",
    2: "not possible: there is a mistake in the command, the workflow or the input",
    3: "finished, but some items failed or were left out, or some cameras are doubtful",
    4: "stopped by a quality threshold or a safety check",
    130: "interrupted",
}


def ending_text(exit_code: int) -> str:
    """Return how a run ended, by its exit code."""
    return _ENDINGS.get(exit_code, "ended by an internal error")
