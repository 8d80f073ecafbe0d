"""Commands of plugins, beside the built-in ones: a typer app, or a function as typer takes it.

    @register_command("hello")
    def hello(name: Annotated[str, typer.Argument(help="Whom to greet.")]) -> None:
        '''Say hello.'''
        Console().say(f"hello {name}")

A command `cache.push` is the command `push` of the group `cache`. The module of an installed plugin is imported when
its command is run, or when the help lists it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from inspect import isfunction
from typing import Annotated, Any

import typer
from rich.errors import MarkupError
from rich.markup import escape, render
from typer.core import TyperGroup
from typer.main import get_command as command_of_app

from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded
from pano_mvs.core.doors import Door, RunOption
from pano_mvs.core.errors import PluginError
from pano_mvs.core.plugin_folders import plugin_files_in, user_plugin_folders
from pano_mvs.core.text import error_text

Command = typer.Typer | Callable[..., None]
Decorator = Callable[[Callable[..., None]], Callable[..., None]]


def _accepted(value: object) -> Command | None:
    """Return a value as a command whose errors become messages and exit codes; None if it is of another kind."""
    if isinstance(value, typer.Typer):
        _guard(value)
        return value
    return guarded(value) if isfunction(value) else None


def _guard(app: typer.Typer) -> None:
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = guarded(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            _guard(group.typer_instance)


COMMANDS = Door[Command]("command", "pano_mvs.commands", accepts=_accepted)


def register_command(name: str) -> Decorator:
    """Return a decorator that registers a function as the command `pano-mvs NAME`.

    Its parameters are annotated as typer's are; errors of `pano_mvs.core.errors` become messages and exit codes.
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        COMMANDS.register(name, guarded(function), function)
        return function

    return register


class PluginGroup(TyperGroup):
    """A group of commands to which plugins add; typer's own types of commands differ between its versions."""

    _describes = False  # whether the help of the group is being made, which shows no options of its commands

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the group."""
        self._describes = True
        try:
            super().format_help(ctx, formatter)
        finally:
            self._describes = False

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands, those of plugins last."""
        own = super().list_commands(ctx)
        load_files()
        prefix = _prefix(ctx)
        return [*own, *(name for full in COMMANDS.names() if (name := _within(full, prefix)) and name not in own)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; of a plugin that cannot be loaded, one that says so."""
        own: Any = super().get_command(ctx, cmd_name)
        if own is not None:
            options = getattr(own.callback, _OPTIONS, None)
            return own if options is None or self._describes else _extended(own, options())
        full = f"{_prefix(ctx)}{cmd_name}"
        broken = load_files() if full not in COMMANDS.names() else []
        if "." in cmd_name or full not in COMMANDS.names():
            return _unusable(_missing(full, broken), cmd_name) if broken else None
        try:
            command = COMMANDS.get(full)
            made = _command(command, cmd_name)
            options = None if isinstance(command, typer.Typer) else getattr(command, _OPTIONS, None)
            return made if options is None or self._describes else _extended(made, options())
        except PluginError as error:
            return _unusable(error, cmd_name)
        except Exception as error:  # typer refuses some annotations
            text = f"the command {full!r} ({COMMANDS.origin(full)}) cannot be used: {error_text(error)}"
            return _unusable(PluginError(text), cmd_name)


def _missing(name: str, broken: Sequence[str]) -> PluginError:
    return PluginError("\n".join([f"there is no command {name!r}; these plugins could not be loaded:", *broken]))


def _prefix(ctx: Any) -> str:
    """Return the names of the groups above the commands of a group, each with a dot; "" for the commands themselves."""
    names = list[str]()
    while ctx.parent is not None:
        names.append(f"{ctx.info_name}.")
        ctx = ctx.parent
    return "".join(reversed(names))


def _within(full: str, prefix: str) -> str:
    """Return the name of a command in a group; "" if it lies elsewhere."""
    name = full.removeprefix(prefix)
    return name if full.startswith(prefix) and "." not in name else ""


def load_files() -> list[str]:
    """Import the files in the user's plugin folders, which register commands, executors and observers.

    Returns:
        Why plugins could not be loaded.
    """
    if any(plugin_files_in(folder) for folder in user_plugin_folders()):
        from pano_mvs.engine.stages.registry import Registry

        return [plugin.why_broken() for plugin in Registry.installed().broken]
    return []


def _command(command: Command, name: str, **context: object) -> Any:
    """Return a command as typer runs it."""
    if not isinstance(command, typer.Typer):
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        app.command(name, context_settings={"help_option_names": ["-h", "--help"], **context})(command)
        command = app
    made = command_of_app(command)
    made.name = name
    if made.help and not _is_markup(made.help):
        made.help = escape(made.help)
    return made


def _is_markup(text: str) -> bool:
    """Return whether rich can print a text, whose paragraphs typer prints one by one."""
    try:
        for paragraph in text.split("\n\n"):
            render(paragraph)
    except MarkupError:
        return False
    return True


def _unusable(error: PluginError, name: str) -> Any:
    """Return a command that prints why a command cannot be used, whatever arguments it is given."""

    def say() -> None:
        Console(stderr=True).say(f"[red]error:[/] {escape(str(error))}")
        raise typer.Exit(error.exit_code)

    say.__doc__ = escape(f"(cannot be used: {' '.join(str(error).split())})")
    return _command(say, name, ignore_unknown_options=True, allow_extra_args=True)


_OPTIONS = "__pano_mvs_options__"


def takes_options(options: Callable[[], Mapping[str, RunOption]]) -> Decorator:
    """Return a decorator of a command that takes options of plugins, too: as argument `options`, name to values.

    The command takes its own options as a record, by `pano_mvs.cli.options.takes_record`.

    Args:
        options: returns the options by name; it is called when the command is run or described.
    """

    def extend(command: Callable[..., None]) -> Callable[..., None]:
        setattr(command, _OPTIONS, options)
        return command

    return extend


def _extended(own: Any, options: Mapping[str, RunOption]) -> Any:
    """Return a command as typer runs it with further options, except those that it has itself."""
    taken = {"-h", "--help", *(text for parameter in own.params for text in parameter.opts)}
    added = {name: option for name, option in options.items() if f"--{name}" not in taken}
    return _command(_with_options(own.callback.__wrapped__, added), own.name)


def options_of_runs() -> dict[str, RunOption]:
    """Return the options that executors and observers add to `pano-mvs run` and to what runs workflows, by name."""
    from pano_mvs.engine.executors.choose import executor_options
    from pano_mvs.session.observers import observer_options

    load_files()
    return {**executor_options(), **observer_options()}


def _with_options(command: Callable[..., None], options: Mapping[str, RunOption]) -> Callable[..., None]:
    """Return a command with further options."""

    def take(**values: Any) -> None:
        given = dict[str, tuple[str, ...]]()
        for number, name in enumerate(options):
            value = values.pop(_parameter(number))
            if value:
                given[name] = () if value is True else tuple(value) if isinstance(value, list) else (value,)
        command(**values, options=given)

    take.__name__, take.__doc__ = command.__name__, command.__doc__
    signature = inspect.signature(command)
    parameters = [*signature.parameters.values(), *map(_as_parameter, options.values(), range(len(options)))]
    take.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    take.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return take


def _as_parameter(option: RunOption, number: int) -> inspect.Parameter:
    info = typer.Option(
        f"--{option.name}",
        help=option.help,
        metavar=option.metavar or None,
        show_default=False,
        rich_help_panel="Plugins",
    )
    hint: Any = bool if not option.metavar else list[str] | None if option.multiple else str
    default = None if option.multiple else "" if option.metavar else False
    parameter = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(_parameter(number), parameter, default=default, annotation=Annotated[hint, info])


def _parameter(number: int) -> str:
    """Return the name of the parameter of an option; that of the option itself may be no name of Python's."""
    return f"plugin_option_{number}"
