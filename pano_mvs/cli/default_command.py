"""A group of commands with a default command."""

from __future__ import annotations

from typing import Any, ClassVar

from typer.core import TyperGroup


class RunByDefault(TyperGroup):
    """Takes `group X …` for `group run X …` unless X is one of its commands."""

    default: ClassVar[str] = "run"

    # The context is click's, whose module differs between versions of typer.
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command if the arguments name none, except when they ask for help."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [self.default, *args]
        return super().parse_args(ctx, args)
