"""The command `torchcrf-scan`: every subcommand is a typed function; its options and help come from signature and docstring.

Exit codes: 0 done, 1 bad input (one line on stderr), 2 bad usage, 130 Ctrl-C, 143 terminated. Dependencies of a single command
are imported there.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields
from typing import Any

from jsonargparse import ActionYesNo, set_parsing_settings

from torchcrf_scan import __version__
from torchcrf_scan.commands.annotate import annotate
from torchcrf_scan.commands.bench import bench
from torchcrf_scan.commands.calibrate import calibrate
from torchcrf_scan.commands.drives import drives
from torchcrf_scan.commands.evaluate import evaluate
from torchcrf_scan.commands.experiment import experiment, experiment_parser
from torchcrf_scan.commands.listen import listen
from torchcrf_scan.commands.match import match
from torchcrf_scan.commands.odometry import odometry
from torchcrf_scan.commands.parser import CommandParser
from torchcrf_scan.commands.play import play
from torchcrf_scan.commands.plot import plot
from torchcrf_scan.commands.prepare import prepare
from torchcrf_scan.commands.recording import Options
from torchcrf_scan.commands.run import run
from torchcrf_scan.commands.simulate import simulate
from torchcrf_scan.commands.track import track
from torchcrf_scan.safe_names import one_line

COMMANDS: Mapping[str, Callable[..., int]] = {
    "run": run,
    "odometry": odometry,
    "track": track,
    "play": play,
    "simulate": simulate,
    "match": match,
    "evaluate": evaluate,
    "calibrate": calibrate,
    "experiment": experiment,
    "plot": plot,
    "annotate": annotate,
    "listen": listen,
    "bench": bench,
    "drives": drives,
    "prepare": prepare,
}

LOGS = "CARMEN, bags of ROS 1 and 2, MCAP, CSV"
POSITIONAL: Mapping[str, tuple[str, str | None, str]] = {  # parameter: metavar, nargs (None: exactly one), help
    "files": ("PAIR.npz|LOG", "+", f"pair files (.npz), folders of them, logs ({LOGS}), or glob patterns"),
    "pair_files": ("PAIR.npz", "+", "pair files (.npz), folders of them, or glob patterns"),
    "file": ("PAIR.npz|LOG", None, f"a pair file (.npz), or with --number a log ({LOGS})"),
    "logs": ("LOG", "+", f"logs ({LOGS})"),
    "log": ("LOG", None, f"a log ({LOGS})"),
}

FLAGS: Mapping[str, str] = {  # parameter that is true or false: help
    "causes": "also tell where wrong points come from, what became of every mover, and what oracles would save (method joint)",
    "rounds": "also tell the joint objective after every step of the rounds, and whether they converge (method joint)",
    "use_odometry": "take the log's odometry as the first guess of the sensor's motion",
    "clean": "also write the log again without the beams that hit moving objects, and a bag with the odometry found",
    "open": "also open the page in the browser",
    "visualize": "show everything in the viewer of rerun while it is computed (extra `viewer`)",
}

SHARED = "options"  # parameter of commands that take the fields of `Options` as options


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code; bad usage and `--help` raise `SystemExit`, as in argparse.

    Args:
        argv: arguments without the program's name; None: those of the process.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    parser = make_parser(COMMANDS.keys() & {*arguments[:1]})
    parsed = parser.parse_args(arguments)
    try:
        options = parser.instantiate(parsed)[parsed.command]
        code = COMMANDS[parsed.command](**arguments_of(COMMANDS[parsed.command], vars(options)))
        if sys.stdout is not None:  # closed before we began (`>&-`)
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output closed the pipe (`| head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError) as error:
        print(f"torchcrf-scan {parsed.command}: error: {one_line(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return code


def arguments_of(command: Callable[..., int], values: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a command; options that several commands share come as one `Options`."""
    if SHARED not in inspect.signature(command).parameters:
        return values
    shared = {field.name: values.pop(field.name) for field in fields(Options)}
    return {**values, SHARED: Options(**shared)}


def make_parser(wanted: Collection[str] = ()) -> CommandParser:
    """The parser of all commands, which takes a quarter of a second to make, or of those that are wanted.

    Args:
        wanted: names of commands; empty: all.
    """
    set_parsing_settings(add_print_completion_argument=True)  # of a shell, where shtab is installed
    description = "Associations, moving objects and motions between two consecutive planar laser scans."
    parser = CommandParser(prog="torchcrf-scan", description=description, version=__version__)
    subcommands = parser.add_subcommands(dest="command")
    for name in wanted or COMMANDS:
        command = COMMANDS[name]
        summary = (inspect.getdoc(command) or "").split("\n\nArgs:")[0]
        subparser = experiment_parser(summary) if command is experiment else _command_parser(name, command, summary)
        subcommands.add_subcommand(name, subparser, help=summary.split("\n")[0])
    return parser


def _command_parser(name: str, command: Callable[..., int], summary: str) -> CommandParser:
    """Options from the signature; parameters in `POSITIONAL` become positional arguments, those in `FLAGS` take no value."""
    parameters = inspect.signature(command).parameters
    forms = {key: metavar + (" ..." if count else "") for key, (metavar, count, _) in POSITIONAL.items()}
    forms |= {"output": "--output OUTPUT"}
    shown = [form for key, form in forms.items() if key in parameters and parameters[key].default is inspect.Parameter.empty]
    parser = CommandParser(description=summary, usage=" ".join(["torchcrf-scan", name, *shown, "[options]"]))
    for key, (metavar, count, meaning) in POSITIONAL.items():
        if key in parameters:
            parser.add_argument(key, type=str, metavar=metavar, nargs=count, help=meaning)
    parser.add_function_arguments(command, as_group=False, as_positional=False, skip={*POSITIONAL, *FLAGS, SHARED})
    if SHARED in parameters:
        parser.add_class_arguments(Options, as_group=False, skip={*FLAGS})
    names = {*parameters, *(field.name for field in fields(Options) if SHARED in parameters)}
    for key, meaning in FLAGS.items():
        if key in names:
            parser.add_argument(f"--{key}", action=ActionYesNo, default=False, help=meaning)
    return parser


if __name__ == "__main__":
    sys.exit(main())
