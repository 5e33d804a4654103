"""Parallel searches, whose points are evaluated as lanes of one program.

Each search runs in its own thread and requests one point at a time. When all running searches have a request, their
points are evaluated together.
"""

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

_Result = TypeVar("_Result")


def in_lockstep(
    searches: int,
    search: Callable[[int, Callable[[np.ndarray], Any]], _Result],
    answers: Callable[[np.ndarray], list[Any]],
) -> list[_Result]:
    """Run searches until all have ended.

    Args:
        searches: number of searches.
        search: from its number and a function that answers one point, to its result.
        answers: evaluates points by row.

    Raises:
        Exception: whatever a search or `answers` raised first.
    """
    turn = threading.Condition()
    waiting: dict[int, np.ndarray] = {}
    answered: dict[int, Any] = {}
    running = set(range(searches))
    results: dict[int, _Result] = {}
    failed: list[BaseException] = []

    def work_out_when_all_have_asked() -> None:
        if not failed and waiting and set(waiting) == running:
            order = sorted(waiting)
            try:
                found = answers(np.stack([waiting[i] for i in order]))
                answered.update(zip(order, found, strict=True))
            except BaseException as error:
                failed.append(error)
            waiting.clear()
        turn.notify_all()

    def ask(number: int, point: np.ndarray) -> Any:
        with turn:
            waiting[number] = np.array(point)
            work_out_when_all_have_asked()
            turn.wait_for(lambda: failed or number in answered)
            if failed:
                raise failed[0]
            return answered.pop(number)

    def run(number: int) -> None:
        try:
            results[number] = search(number, lambda point: ask(number, point))
        except BaseException as error:
            with turn:
                failed.append(error)
        finally:
            with turn:
                running.discard(number)
                work_out_when_all_have_asked()

    threads = [threading.Thread(target=run, args=(i,), daemon=True) for i in range(searches)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        raise failed[0]
    return [results[i] for i in range(searches)]
