# SPDX-License-Identifier: Apache-2.0
"""`ggslam` and `python -m ggslam`: the command line as a program of its own, which ends for good when it is done."""

from __future__ import annotations

from ggslam.system.exit_signals import run_program


def main() -> None:
    """Entry point of the installed command; does not return. Exit codes as of `ggslam.cli.main.main`."""

    def command_line() -> None:
        from ggslam.cli.main import main as command

        command()

    run_program(command_line)


if __name__ == "__main__":
    main()
