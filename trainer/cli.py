"""The `trainer` command. This module imports nothing heavy: `trainer --help` answers at once."""

from __future__ import annotations

import argparse
import difflib
import importlib
import importlib.util
import io
import os
import re
import signal
import sys

from trainer.configs import UsageError

TRAINING = {
    "fit": "train a denoiser from a configuration, track it, export it",
    "validate": "score a checkpoint on the validation crops",
    "test": "score a checkpoint on the held-out scenes and print the table",
}
COMMANDS = {
    "render": "render a data set with Mitsuba: random scenes, or yours",
    "ingest": "read a published or rendered data set into frames and a manifest",
    "prepare": "cut frames into shards of training patches",
    "inspect": "say what a file, a data set or shards contain",
    "denoise": "denoise EXR files and sequences",
    "benchmark": "measure time and memory of denoisers, or compare two",
    "evaluate": "compare denoisers on the same frames: metrics, tables, a report",
    "export": "write a trained denoiser as ONNX or TorchScript",
    "models": "list denoisers, their options, and registered models",
    "upload": "send a run that was tracked locally to a tracking server",
    "sync": "send to the tracking server what a run could not deliver yet",
    "submit": "run a training, or many independent jobs, on a Ray cluster",
    "tune": "search hyper-parameters with Ray Tune",
    "ablate": "train variants of a configuration and tabulate them",
    "serve": "denoise over HTTP",
}

# Failures of the surroundings (device, tracking store) that libraries report with classes of their own. They
# are known by name, since importing the classes would make every command slow.
FORESEEN = {
    "lightning.fabric.utilities.exceptions.MisconfigurationException": "",
    "mlflow.exceptions.MlflowException": "the tracking store",
    "sqlalchemy.exc.SQLAlchemyError": "the tracking store",
    "alembic.util.exc.CommandError": "the tracking store",
    "torch.OutOfMemoryError": "",
    "torch.distributed.DistNetworkError": "",
}
# PyTorch reports a missing or full device as a plain RuntimeError or AssertionError.
DEVICE_FAILURE = re.compile(
    r"not compiled with \w+ enabled|not linked with support for|No CUDA GPUs|no NVIDIA driver|invalid device "
    r"ordinal|Invalid device string|device type at start of device string|can't allocate memory|CUDA driver "
    r"version is insufficient|out of memory|no kernel image is available|devices are busy or unavailable",
    re.IGNORECASE,
)
# What the others of a training see when one process of it ends.
LOST_PROCESS = re.compile(
    r"Connection (closed|reset) by peer|Broken pipe|NCCL.*(remote process exited|timeout)|"
    r"Timed out waiting|Socket Timeout|wait timeout|connection was (closed|refused)",
    re.IGNORECASE | re.DOTALL,
)
LOST_READER = re.compile(r"DataLoader worker \(pid\(?s?\)? [\d, ]+\)[^.\n]*")
DATABASE_DETAIL = ("[SQL:", "[parameters:", "(Background on", "(raised as a result of")


def usage() -> str:
    """Return the text of `trainer --help`."""
    width = max(map(len, (*TRAINING, *COMMANDS)))
    lines = ["usage: trainer COMMAND [options]", "", "Train, compare and ship Monte Carlo denoisers.", ""]
    for title, table in (("training", TRAINING), ("data, use and upkeep", COMMANDS)):
        lines += [f"{title}:", *(f"  {name:<{width}}  {text}" for name, text in table.items()), ""]
    lines += [
        "`trainer COMMAND --help` lists the options of a command. A first run:",
        "  trainer fit --config wskp_bmfr.yaml",
    ]
    return "\n".join(lines)


def main() -> int:
    """Run the command line `sys.argv` and return the exit code: 0 done, 1 failed, 2 wrong usage."""
    # Threads that spin while they wait take the cores from each other as soon as a loader's worker or any
    # other program runs; must be set before PyTorch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # not every encoding has ↑, – and µ
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage())
        return 0 if arguments else 2
    if arguments[0] in ("-V", "--version"):
        from importlib.metadata import version

        print(f"penumbra-denoise {version('penumbra-denoise')}")
        return 0
    verb = arguments[0]
    if verb not in TRAINING and verb not in COMMANDS:
        near = difflib.get_close_matches(verb, [*TRAINING, *COMMANDS], n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        print(f"error: unknown command {verb!r}{hint} (see trainer --help)", file=sys.stderr)
        return 2
    try:
        return _run(verb, arguments[1:])
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        message = foreseen(error)
        if message is None or os.environ.get("PENUMBRA_TRACEBACK"):
            raise
        # PyTorch's handler raises when a process that reads data ends, also while this one is ending.
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        print(f"error: {message}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1


def foreseen(error: Exception) -> str | None:
    """Return what to print for an error that a user can mend, None for one that is a bug."""
    if isinstance(error, (ValueError, OSError)):
        return str(error)
    lines = [line.strip() for line in str(error).splitlines()]
    lines = [line for line in lines if line and not line.startswith(DATABASE_DETAIL)]
    text = lines[0] if lines else type(error).__name__
    names = {f"{cls.__module__}.{cls.__name__}" for cls in type(error).__mro__}
    for name in FORESEEN.keys() & names:
        if not FORESEEN[name]:
            return text
        return f"{FORESEEN[name]} (MLFLOW_TRACKING_URI, or runs/mlflow.db) cannot be used: {text}"
    if isinstance(error, (RuntimeError, AssertionError)) and DEVICE_FAILURE.search(text):
        return text
    return _lost(str(error)) if isinstance(error, RuntimeError) else None


def _lost(text: str) -> str | None:
    """Return what to print where another process of the training ended, None for any other failure."""
    if reader := LOST_READER.search(text):
        return (
            f"{reader.group()}; if nobody ended it, the machine ran out of memory: use fewer "
            "--data.init_args.workers. Continue with --ckpt_path last"
        )
    if lost := LOST_PROCESS.search(text):
        return (
            f"another process of this training ended ({lost.group().splitlines()[0]}); its own message says "
            "why. Continue with --ckpt_path last"
        )
    return None


def _run(verb: str, arguments: list[str]) -> int:
    _check_packages()
    if verb in TRAINING:
        from trainer.training import run_training

        return run_training(verb, arguments)
    command = importlib.import_module(f"trainer.commands.{verb}")
    parser = argparse.ArgumentParser(prog=f"trainer {verb}", description=command.HELP)
    command.add_arguments(parser)
    if getattr(command, "PASSES_ON", False):  # options that it does not know are another command's
        options, rest = parser.parse_known_args(arguments)
        options.rest = rest
    else:
        options = parser.parse_args(arguments)
    code: int = command.run(options)
    return code


def _check_packages() -> None:
    """Explain a clash of the common package names instead of failing inside another package."""
    for name in ("data", "models"):
        spec = importlib.util.find_spec(name)
        place = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
        origin = spec.origin if spec else None
        found = os.path.dirname(os.path.dirname(os.path.abspath(origin))) if origin else None
        if found != place:
            raise ValueError(
                f"the package {name!r} is taken from {found or 'another folder'}, not from Penumbra "
                f"({place}); start the command elsewhere or use an environment of its own"
            )
