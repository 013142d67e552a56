# SPDX-License-Identifier: Apache-2.0
"""YAML as settings need it: maps, lists, texts, numbers, truth values and null.

What makes YAML dangerous or surprising is left out: aliases (nine lines of them make a billion entries), tags, dates
(2024-01-01 is a text here), binary data, sexagesimal numbers (1:30 is a text) and endless nesting. 1e-3 is a number, as
everywhere but in YAML 1.1.
"""

from __future__ import annotations

import copy
import re
from functools import lru_cache
from typing import Any

import yaml

from ggslam.system.tuning import Tuning


class YamlTuning(Tuning):
    """Limits on hostile files."""

    max_depth = 32
    """Deepest nesting."""
    max_characters = 1 << 20
    """Longest text, in characters."""
    kept_characters = 1 << 16
    """Longest text, in characters, whose content is kept in memory for the next time."""


class PlainYamlError(ValueError):
    """The text is no YAML, or no plain one; says what and where."""


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader without all that is not plain."""

    yaml_implicit_resolvers: dict[str, list[Any]] = {}
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One node; PyYAML calls it for every one."""
        if self.check_event(yaml.events.AliasEvent):
            event = self.peek_event()
            raise PlainYamlError(f"line {event.start_mark.line + 1}: aliases (*{event.anchor}) are not read")
        self.depth += 1
        if self.depth > YamlTuning.max_depth:
            line = self.peek_event().start_mark.line + 1
            raise PlainYamlError(f"line {line}: nested deeper than {YamlTuning.max_depth} levels")
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """The value of a node."""
        if node.tag not in _TAGS:
            raise PlainYamlError(f"line {node.start_mark.line + 1}: {node.tag.split(':')[-1]} is not read")
        return super().construct_object(node, deep)


_TAGS = {f"tag:yaml.org,2002:{name}" for name in ("map", "seq", "str", "int", "float", "bool", "null")}
_WORDS: list[tuple[str, str, list[str]]] = [
    ("bool", r"(?:yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF)", list("yYnNtTfFoO")),
    ("null", r"(?:~|null|Null|NULL|)", ["~", "n", "N", ""]),
    ("int", r"[-+]?(?:0b[01_]+|0x[0-9a-fA-F_]+|0o?[0-7_]+|0|[1-9][0-9_]*)", list("-+0123456789")),
    ("float", r"[-+]?(?:(?:[0-9][0-9_]*)?\.[0-9_]+|[0-9][0-9_]*\.|[0-9][0-9_]*(?=[eE]))(?:[eE][-+]?[0-9]+)?"
              r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", list("-+0123456789.")),
]  # fmt: skip
for _kind, _pattern, _first in _WORDS:
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(f"^(?:{_pattern})$"), _first)


def parse_yaml(text: str) -> Any:
    """Content of a text in YAML.

    Raises:
        PlainYamlError: it is none, or not plain; one line.
    """
    if len(text) > YamlTuning.max_characters:
        raise PlainYamlError(f"{len(text):,} characters; at most {YamlTuning.max_characters:,} are read")
    # One command asks for a run's settings several times, and reading them takes 20 ms.
    return copy.deepcopy(_parse_again(text)) if len(text) < YamlTuning.kept_characters else _parse(text)


def _parse(text: str) -> Any:
    try:
        return yaml.load(text, _Loader)  # a loader safer than the safe one
    except PlainYamlError:
        raise
    except (yaml.YAMLError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise PlainYamlError(" ".join(str(error).split())) from None


_parse_again = lru_cache(maxsize=16)(_parse)


def repeated_key(text: str) -> tuple[str, int] | None:
    """A name that a map of a text in YAML holds twice, of which only the last would count, and its line; None if there
    is none.

    Raises:
        PlainYamlError: it is no YAML.
    """
    try:
        pending = [yaml.compose(text, _Loader)]
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise PlainYamlError(" ".join(str(error).split())) from None
    while pending:
        node = pending.pop()
        if isinstance(node, yaml.MappingNode):
            names = [key.value for key, _ in node.value]
            for number, (key, value) in enumerate(node.value):
                if isinstance(key, yaml.ScalarNode) and key.value in names[:number]:
                    return str(key.value), key.start_mark.line + 1
                pending.append(value)
        elif isinstance(node, yaml.SequenceNode):
            pending += node.value
    return None
