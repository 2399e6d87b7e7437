"""One thread is kept quiet, whatever others print and in whatever order they leave."""

import sys
import threading

from data.muted import muted


def test_only_what_this_thread_prints_is_dropped(capsys):
    before = sys.stdout
    with muted():
        print("from the library")
        other = threading.Thread(target=print, args=("from another thread",))
        other.start()
        other.join()
    print("afterwards")
    assert capsys.readouterr().out == "from another thread\nafterwards\n"
    assert sys.stdout is before


def test_standard_output_comes_back_where_threads_leave_in_the_order_in_which_they_came(capsys):
    before = sys.stdout
    inside, left, go = threading.Event(), threading.Event(), threading.Event()

    def first():
        with muted():
            inside.set()
            go.wait(10)
        left.set()

    thread = threading.Thread(target=first)
    thread.start()
    inside.wait(10)
    with muted(), muted():
        go.set()
        left.wait(10)
        print("still quiet")
    thread.join()
    print("heard")
    assert sys.stdout is before
    assert capsys.readouterr().out == "heard\n"
