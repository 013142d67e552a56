# SPDX-License-Identifier: Apache-2.0
"""Names that options had in earlier versions: still understood, shown in no help."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand

from ggslam.cli.usage_words import UsageError, in_own_words

OLD_NAMES = {
    "compare": {"--json": "--out"},
    "decode": {"--workers": "--threads"},
    "export": {"--recording": "--sequence"},
    "localize": {"--first": "--start"},
    "submaps": {"--first": "--start"},
    "volumes": {"--report": "--driving"},
}
"""Of each command: an option's old name and the one that it has now."""


class Command(TyperCommand):
    """A command that understands the old names of its options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parses the words after they were put into today's names; what follows a lone `--` is no option."""
        names = OLD_NAMES.get(str(ctx.info_name), {})
        end = args.index("--") if "--" in args else len(args)
        words = [_translate(word, names) for word in args[:end]] + args[end:]
        try:
            return list(super().parse_args(ctx, list(words)))
        except UsageError as error:
            error.ctx = error.ctx or ctx
            raise in_own_words(error, words) from None


def _translate(word: str, names: dict[str, str]) -> str:
    name, equals, value = word.partition("=")
    return names.get(name, name) + equals + value
