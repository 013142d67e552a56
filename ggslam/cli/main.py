# SPDX-License-Identifier: Apache-2.0
"""The command line: `ggslam COMMAND`. Each command is one small file: parse, call, print."""

from __future__ import annotations

import errno
import sys
import warnings
from collections.abc import Callable
from typing import Any

import typer
from rich.markup import escape
from typer.core import TyperCommand, TyperGroup

from ggslam import __version__
from ggslam.cli import (
    batch_command,
    changes_command,
    compare_command,
    decode_command,
    doctor_command,
    edit_command,
    encode_command,
    eval_command,
    export_command,
    inspect_command,
    localize_command,
    merge_command,
    plan_command,
    play_command,
    refine_command,
    render_command,
    report_command,
    run_command,
    serve_command,
    submaps_command,
    synth_command,
    update_command,
    verify_command,
    view_command,
    volumes_command,
)
from ggslam.cli.argument_names import with_options
from ggslam.cli.console import PlainConsole
from ggslam.cli.old_names import Command
from ggslam.cli.recognition import with_advice
from ggslam.cli.usage_words import UsageError, in_own_words
from ggslam.errors import AnotherKindError, GgslamError
from ggslam.system.interrupts import Interrupted, exit_code, stop_like_ctrl_c
from ggslam.system.tuning import Tuning


class MessageTuning(Tuning):
    """How errors are printed."""

    name_length = 60
    """Characters that are printed of a file name that is too long."""


_TORCH_HAS_NO_MEMORY = "DefaultCPUAllocator: "
"""How torch says so; it has no class of errors for it."""


class _Commands(TyperGroup):
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parses the words before the command's name."""
        try:
            return list(super().parse_args(ctx, list(args)))
        except UsageError as error:
            raise in_own_words(error, args) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[Any, Any, list[str]]:
        """The command of a name."""
        try:
            return super().resolve_command(ctx, args)
        except UsageError as error:
            error.ctx = error.ctx or ctx
            raise in_own_words(error, args) from None

    def invoke(self, context: Any) -> Any:
        """Runs a command; errors that name arguments name options from here on."""
        try:
            with stop_like_ctrl_c():
                return super().invoke(context)
        except UsageError as error:
            raise in_own_words(error) from None
        except GgslamError as error:
            text = with_advice(error) if isinstance(error, AnotherKindError) else str(error)
            error.args = (with_options(text),)
            raise
        except Interrupted as stop:  # Ctrl-C itself is typer's
            raise SystemExit(exit_code(stop)) from None


app = typer.Typer(
    cls=_Commands,
    name="ggslam",
    help="RGB-D Gaussian SLAM on two CPU cores: a recording in; trajectory, Gaussian map and scores out.",
    no_args_is_help=True,
    add_completion=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ggslam {__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Print the version."),
) -> None:
    pass


_COMMANDS: dict[str, tuple[Callable[..., None], str]] = {
    "run": (run_command.run, run_command.EPILOG), "eval": (eval_command.evaluate, eval_command.EPILOG),
    "render": (render_command.render, render_command.EPILOG), "export": (export_command.export, export_command.EPILOG),
    "batch": (batch_command.batch, batch_command.EPILOG),
    "report": (report_command.report, report_command.EPILOG),
    "changes": (changes_command.changes, changes_command.EPILOG),
    "compare": (compare_command.compare, compare_command.EPILOG),
    "doctor": (doctor_command.doctor, doctor_command.EPILOG), "edit": (edit_command.edit, edit_command.EPILOG),
    "encode": (encode_command.encode, encode_command.EPILOG), "decode": (decode_command.decode, decode_command.EPILOG),
    "localize": (localize_command.localize, localize_command.EPILOG),
    "merge": (merge_command.merge, merge_command.EPILOG),
    "plan": (plan_command.plan, plan_command.EPILOG), "play": (play_command.play, play_command.EPILOG),
    "refine": (refine_command.refine, refine_command.EPILOG),
    "serve": (serve_command.serve, serve_command.EPILOG),
    "submaps": (submaps_command.submaps, submaps_command.EPILOG),
    "update": (update_command.update, update_command.EPILOG),
    "view": (view_command.view, view_command.EPILOG),
    "volumes": (volumes_command.volumes, volumes_command.EPILOG),
    "verify": (verify_command.verify, verify_command.EPILOG),
    "synth": (synth_command.synth, synth_command.EPILOG), "inspect": (inspect_command.inspect, inspect_command.EPILOG),
}  # fmt: skip
_CLASSES: dict[str, type[TyperCommand]] = {"edit": edit_command.EditCommand, "export": export_command.ExportCommand}
for _name, (_function, _epilog) in _COMMANDS.items():
    app.command(_name, cls=_CLASSES.get(_name, Command), epilog=_epilog, no_args_is_help=_name != "doctor")(_function)


def main() -> None:
    """Entry point. Exit codes: 0 done, 3 done but bad (`run --strict`; `plan`: no path), 2 the user's input is at
    fault, 1 ggslam or the machine is, or most frames of a run were lost, 130 Ctrl-C, 128 + the number of another signal
    that ended it (143 SIGTERM, 129 SIGHUP)."""
    errors = PlainConsole(stderr=True)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: errors.print(f"note: {message}", highlight=False, markup=False)
            app()
    except GgslamError as error:
        errors.print(f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(error.exit_code)
    except SystemExit as end:
        if end.code in (129, 130, 143):  # what typer makes of Ctrl-C, without a word
            errors.print("interrupted")
        raise
    except OSError as error:
        too_long = error.errno == errno.ENAMETOOLONG
        said = f"{str(error.filename)[:MessageTuning.name_length]!r}...: {error.strerror}" if too_long else error
        errors.print(f"error: {said}", highlight=False, soft_wrap=True, markup=False)
        sys.exit(2 if too_long else 1)
    except Exception as error:
        text = _in_words(error)
        if text is None:
            raise
        errors.print(f"error: {text}", highlight=False, soft_wrap=True, markup=False)
        sys.exit(1)


def _in_words(error: Exception) -> str | None:
    """What an error of a library means for people, by its name, for torch and OpenCV are loaded late; None: nobody
    foresaw it."""
    kind = type(error)
    if isinstance(error, RuntimeError) and kind.__name__ == "OutOfMemoryError":  # torch's, of a GPU
        return f"the GPU's memory is full: {error}; smaller images (--scale 0.5) take less, --device cpu takes none"
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _TORCH_HAS_NO_MEMORY in str(error)):
        reason = str(error).strip().splitlines()
        return f"memory is full{f': {reason[-1]}' if reason else ''}; smaller images (--scale 0.5) take less"
    if (kind.__module__, kind.__name__) == ("cv2", "error"):
        from ggslam.system.opencv import opencv_reason

        return f"OpenCV: {opencv_reason(error)}; this is a fault of ggslam, please report the command"
    return None


if __name__ == "__main__":
    main()
