"""
``python -m rl_zoo_plugin train --algo hds --env Pendulum-v1``: the zoo's commands with our
algorithms, without the hook at the start of the interpreter.
"""

import runpy
import sys
from importlib.util import find_spec

from rl_zoo_plugin import hook

_COMMANDS = ("train", "enjoy", "all_plots", "plot_from_file", "plot_train")
_MODULES = ("record_video", "record_training", "load_from_hub", "push_to_hub")


def main() -> None:
    """
    Run the command that the first argument names, with the arguments that follow.

    :raises SystemExit: without a known command, or without ``rl_zoo3``
    """
    command = sys.argv[1] if len(sys.argv) > 1 else ""
    if command not in _COMMANDS + _MODULES:
        sys.exit(
            f"Unknown command '{command}'. Usage: python -m rl_zoo_plugin COMMAND ..., "
            f"where COMMAND is one of {', '.join(_COMMANDS + _MODULES)}."
        )
    if find_spec("rl_zoo3") is None:
        sys.exit("rl_zoo3 is not installed. Install it with: pip install 'sb3-hds[zoo]'")
    hook.install()
    if command in _COMMANDS:
        from rl_zoo3 import cli

        cli.main()
    else:
        del sys.argv[1]
        runpy.run_module(f"rl_zoo3.{command}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
