"""A group of commands one of which may be left out when it is called."""

from __future__ import annotations

from typing import Any, ClassVar

from typer.core import TyperGroup


class RunByDefault(TyperGroup):
    """Takes `group X …` for `group run X …` unless X is one of its commands."""

    default: ClassVar[str] = "run"

    # The context is click's, which versions of typer bring under different names.
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the default command in front of arguments that name none; asking for help names none either."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [self.default, *args]
        return super().parse_args(ctx, args)
