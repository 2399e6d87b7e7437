"""The `trainer` command. This module imports nothing heavy: `trainer --help` answers at once."""

from __future__ import annotations

import argparse
import difflib
import importlib
import importlib.util
import os
import sys

from trainer.configs import UsageError

TRAINING = {
    "fit": "train a denoiser from a configuration, track it, export it",
    "validate": "score a checkpoint on the validation crops",
    "test": "score a checkpoint on the held-out scenes and print the table",
}
COMMANDS = {
    "ingest": "read a published or rendered data set into frames and a manifest",
    "prepare": "cut frames into shards of training patches",
    "inspect": "say what a file, a data set or shards contain",
    "denoise": "denoise EXR files and sequences",
    "export": "write a trained denoiser as ONNX or TorchScript",
    "models": "list denoisers and registered models",
    "upload": "send a run that was tracked locally to a tracking server",
}


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
    except (ValueError, OSError) as error:
        if os.environ.get("PENUMBRA_TRACEBACK"):
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1


def _run(verb: str, arguments: list[str]) -> int:
    _check_packages()
    if verb in TRAINING:
        from trainer.training import run_training

        return run_training(verb, arguments)
    command = importlib.import_module(f"trainer.commands.{verb}")
    parser = argparse.ArgumentParser(prog=f"trainer {verb}", description=command.HELP)
    command.add_arguments(parser)
    code: int = command.run(parser.parse_args(arguments))
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
