"""Searches the rules of durable tasks' registers, and shows that the search would see a broken rule."""

from __future__ import annotations

import multiprocessing
import time

import click
from register.mutants import MUTANTS, Mutant
from register.scenarios import DEEP, LIARS, SUITE, Scenario
from register.search import Search
from register.world import Result


def search_one(job: tuple[Scenario | Mutant, int]) -> tuple[str, str, Result]:
    what, limit = job
    if isinstance(what, Mutant):
        title, found = what.convict(limit)
        return what.name, title, found
    return what.title, "", Search(what, limit=limit).run()


def name_of(what: Scenario | Mutant) -> str:
    """Return what a search is called."""
    return what.name if isinstance(what, Mutant) else what.title


@click.command()
@click.option("--mutants", is_flag=True, help="Search broken variants instead, each of which must be convicted.")
@click.option("--deep", is_flag=True, help="Search the large scenarios instead: minutes, and some gigabytes.")
@click.option("--only", default="", help="Only scenarios with this text in their title.")
@click.option("--jobs", default=2, show_default=True, help="How many searches run at a time.")
@click.option("--limit", default=2_000_000, show_default=True, help="The most states of one search.")
def main(mutants: bool, deep: bool, only: str, jobs: int, limit: int) -> None:
    """Search all interleavings of the registers of a durable task."""
    began_s, bad, states, transitions = time.perf_counter(), 0, 0, 0
    scenarios = DEEP if deep else (*SUITE, *LIARS)
    chosen = [(it, limit) for it in (MUTANTS if mutants else scenarios) if only in name_of(it)]
    if not chosen:
        raise click.UsageError(f"--only: nothing has {only!r} in its title")
    with multiprocessing.Pool(jobs, maxtasksperchild=1) as pool:
        for name, found_in, found in pool.imap(search_one, chosen):
            is_sound = found.verdict == "ok"
            is_good = not is_sound and found.verdict != "unfinished" if mutants else is_sound
            bad += not is_good
            states, transitions = states + found.states, transitions + found.transitions
            figures = f"{found.states:>9,} states {found.transitions:>11,} transitions {found.seconds:6.1f} s"
            click.echo(f"{'ok ' if is_good else 'BAD'} {name:<44}{figures}  {found_in}{found.waits or ''}")
            if mutants or not is_good:
                click.echo(f"    {found.verdict}, after {len(found.trace)} steps")
            for number, sentence in enumerate(() if mutants else found.trace, 1):
                click.echo(f"    {number:2}. {sentence}")
    seconds = time.perf_counter() - began_s
    click.echo(f"{len(chosen)} searches, {states:,} states, {transitions:,} transitions, {seconds:.0f} s, {bad} bad")
    raise SystemExit(1 if bad else 0)


if __name__ == "__main__":
    main()
