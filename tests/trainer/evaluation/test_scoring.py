"""Scores are taken beside the methods, afterwards on all cores; one that dies loses little."""

import os
import signal
import threading
import time
from functools import partial

import pytest

from trainer.evaluation import results, scoring
from trainer.evaluation.scoring import Scorers


def took(question):
    """Stands for `score`: answers with when it began and ended; dies where asked to."""
    if question == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    began = time.monotonic()
    time.sleep(0.05)
    return began, time.monotonic()


@pytest.fixture
def answers(monkeypatch):
    """Let questions be answered by `took`; collects what came back."""
    monkeypatch.setattr(scoring, "score", took)
    found = []
    return found


def draw(place, here):
    """Draws; dies anywhere but in the process `here`."""
    if os.getpid() != here:
        os.kill(os.getpid(), signal.SIGKILL)
    place.write_text("plots")


def test_plots_and_sheets_are_drawn_here_where_a_process_that_draws_them_was_killed(tmp_path):
    tasks = [partial(draw, tmp_path / name, os.getpid()) for name in ("plots", "sheets")]
    with results._drawn(*tasks):
        (tmp_path / "page").write_text("page")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page", "plots", "sheets"]


def test_what_drawing_raises_is_raised(tmp_path):
    with pytest.raises(FileNotFoundError, match="lost"), results._drawn(partial(os.stat, tmp_path / "lost")):
        pass


def test_every_question_is_answered_before_the_block_ends(answers):
    with Scorers(1) as scorers:
        for number in range(10):
            scorers.ask(number, lambda answer: answers.append(answer.result()))
    assert len(answers) == 10


def test_no_more_at_a_time_than_asked_for_while_methods_run(answers):
    over = threading.Event()

    def done(answer):
        answers.append(answer.result())
        if len(answers) == 4:
            over.set()

    with Scorers(1) as scorers:
        for number in range(4):
            scorers.ask(number, done)
        assert over.wait(60)
    ends = [end for _, end in answers]
    begins = [began for began, _ in answers]
    assert all(end <= began for end, began in zip(ends, begins[1:], strict=False))


def test_a_scorer_that_dies_costs_what_is_scored_at_that_moment_only(answers):
    lost = []

    def done(answer):
        (lost if answer.exception() else answers).append(answer)

    with Scorers(1) as scorers:
        for question in ("die", *range(7)):
            scorers.ask(question, done)
    assert 1 <= len(lost) <= scorers.cores
    assert len(lost) + len(answers) == 8


def test_an_error_drops_the_questions_that_wait(answers):
    def interrupted():
        with Scorers(1) as scorers:
            for number in range(1000):
                scorers.ask(number, answers.append)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(answers) < 10
