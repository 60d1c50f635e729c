"""`pancakes keys ...`: manage the keys of the members of a fleet, and their rights."""

from __future__ import annotations

import datetime
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from pancakes.errors import PancakesError, needing_extra
from pancakes.security import key_store
from pancakes.security.key_store import KeyFiles
from pancakes.security.roster import EVERY, PEOPLE, RIGHTS, AccessRule, Bearer, CertifiedRole, Right, allows
from pancakes.tools.cli.agent_requests import confirm, yes_option
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import AgentAddress, Duration, format_option
from pancakes.tools.cli.output import DRY_RUN, Printer
from pancakes.tools.cli.password_prompt import ask_password
from pancakes.tools.cli.verbs.keys_authority import founded, opened, spread
from pancakes.util.text import fault_of_name

if TYPE_CHECKING:
    from pancakes.security.authority import Authority
    from pancakes.security.key_store import Entry

PORT: Final = 7490
COLUMNS: Final = ("name", "role", "groups", "state", "since", "ends", "came_from", "serial")
_LONGEST_NAME: Final = 40  # the names of a person's terminals add a dot and more to it

_F = TypeVar("_F", bound=Callable[..., Any])


class BearerName(click.ParamType):
    """The name of a fleet, an agent or a person."""

    name = "name"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        text = str(value)
        if fault := fault_of_name(text):
            self.fail(fault, param, ctx)
        if len(text) > _LONGEST_NAME:
            self.fail(f"{text!r} has {len(text)} letters; at most {_LONGEST_NAME} are allowed", param, ctx)
        return text


of_fleet = click.option(
    "--fleet", "fleet_name", metavar="NAME", default="", help="The fleet. [default: the only one founded here]"
)
may_be_dry = click.option(
    "--dry-run", is_flag=True, help="Only show what would be done, without asking for a password."
)
any_date_option = click.option("--any-date", is_flag=True, help="Make agents accept the roster whatever its date.")
_at = click.option(
    "--at",
    "addresses",
    metavar="HOST[:PORT]",
    type=AgentAddress(),
    multiple=True,
    help="Pass it to the agent at this address, which passes it to its fleet, instead of the agents of this machine."
    " Repeatable.",
)
_timeout = click.option(
    "--timeout",
    "timeout_s",
    metavar="TIME",
    type=Duration(most_s=3600.0),
    default="15s",
    show_default=True,
    help="How long agents may take to apply it; a small computer takes seconds to check a roster.",
)


def passes_it_on(function: _F) -> _F:
    """Give a verb the options `--at` and `--timeout` for passing the roster to agents: `addresses`, `timeout_s`."""
    return _at(_timeout(function))


waits_option = click.option(
    "--timeout",
    "timeout_s",
    metavar="TIME",
    type=Duration(most_s=86400.0),
    default="10min",
    show_default=True,
    help="How long to wait for the newcomer.",
)


def _host(ctx: click.Context, param: click.Parameter, text: str) -> str:
    """Return a name or number of a host, without brackets."""
    from pancakes.mesh.address import parse_address

    host = text.removeprefix("[").removesuffix("]")
    try:
        parse_address(f"tcp://[{host}]:1" if ":" in host else f"tcp://{host or 'localhost'}:1")
    except ValueError:
        raise click.BadParameter(f"{text!r} is not the address of a machine, such as 192.168.1.10") from None
    return host


host_option = click.option(
    "--host", metavar="ADDRESS", default="", callback=_host, help="This machine's address, as seen from there."
)


_out = click.option(
    "--out", type=click.Path(path_type=Path), help="Write the keys to this folder, to be copied there, and do not wait."
)
_port = click.option(
    "--port", type=click.IntRange(0, 65535), default=PORT, show_default=True, help="The port to wait at."
)


def gives_keys(function: _F) -> _F:
    """Give a verb the options that say how a newcomer gets its keys: `out`, `host`, `port`, `timeout_s`."""
    return _out(host_option(_port(waits_option(function))))


SECTIONS: Final = {
    "Members": {
        "init": "Found a fleet: create its authority here.",
        "enrol": "Admit a machine or a person.",
        "join": "Join a fleet, with a code or a folder.",
        "list": "List certificates that were issued.",
        "renew": "Give a member a new key and certificate.",
        "revoke": "Revoke the certificates of a member.",
    },
    "Rights": {
        "allow": "Give rights to members.",
        "can": "Show whether a member may do something, and why.",
    },
    "Roster": {
        "sign": "Sign the roster again, and pass it on.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def keys() -> None:
    """Manage the keys of the members of a fleet, and their rights.

    Over tcp://, agents talk only to peers that have a certificate of their fleet. The authority of the fleet issues
    certificates: a key in ~/.config/pancakes/fleets/FLEET, which `init` creates, and which no robot needs. Robots and
    other people `join`, with a code that `enrol` shows or with a folder that it writes.
    """


@keys.command()
@click.argument("name", metavar="FLEET", type=BearerName())
@click.option("--me", "person", metavar="NAME", type=BearerName(), help="Your name in it. [default: your user's]")
@click.option("--no-password", is_flag=True, help="Leave the authority's key unlocked.")
@may_be_dry
@format_option
def init(name: str, person: str | None, no_password: bool, dry_run: bool, printer: Printer) -> None:
    """Found a fleet: create its authority here, and make you its operator.

    The authority's key is locked with a password. Each command that issues or revokes a certificate asks for it.

    \b
    Example:
        pancakes keys init garage
    """
    folder = key_store.fleets() / name
    who = person or _own_name()
    with needing_extra("no fleet can be founded"):
        from pancakes.security.authority import Authority
    if folder.exists() and any(folder.iterdir()):
        raise PancakesError(f"the fleet {name} exists already, in {folder}")
    row = {"fleet": name, "folder": str(folder), "operator": who}
    if dry_run:
        printer.emit(
            [{**row, "done": DRY_RUN}], f"The fleet {name} would be in {folder}, with you as its operator {who}."
        )
        return
    password = None if no_password else ask_password("Password", again=True)
    authority = Authority.founded(name, folder, password.encode() if password else None)
    authority.enrol_with_key("operator", who).write(key_store.folder_of_person(name))
    until = _date(authority.latest(who).ends_s)
    said = f"The fleet {name} is in {folder}. You are its operator {who} until {until}."
    printer.emit([{**row, "until": until, "done": "founded"}], said)


@keys.command()
@click.argument("name", type=BearerName())
@click.option(
    "--role",
    type=click.Choice(["agent", "environment", "operator", "observer"]),
    default="agent",
    show_default=True,
    help="An agent, a simulated world, or a person who may change things (operator) or only look (observer).",
)
@click.option(
    "--group", "groups", metavar="GROUP", multiple=True, type=BearerName(), help="A group that it is in. Repeatable."
)
@gives_keys
@of_fleet
@may_be_dry
@format_option
def enrol(
    name: str,
    role: CertifiedRole,
    groups: tuple[str, ...],
    out: Path | None,
    host: str,
    port: int,
    timeout_s: float,
    fleet_name: str,
    dry_run: bool,
    printer: Printer,
) -> None:
    """Admit a machine or a person to the fleet, under this name.

    It shows a code, and waits until the newcomer uses it: `pancakes keys join CODE`. The newcomer creates its own key.
    With --out it does not wait, and the folder contains the private key: copy it in a way that others cannot read.

    \b
    Example:
        pancakes keys enrol agent1 --group field
        pancakes keys enrol agent2 --out agent2/
        pancakes keys enrol bob --role observer
    """
    from pancakes.security.key_store import read_register

    folder = founded(fleet_name)
    read_register(folder).check_new(name, folder.name)
    if dry_run:
        _give_dry(folder.name, role, name, out, printer)
        return
    authority = opened(fleet_name)
    _give(authority, role, name, groups, out, host, port, timeout_s, printer)


@keys.command()
@click.argument("name", metavar="NAME")
@gives_keys
@of_fleet
@may_be_dry
@format_option
def renew(
    name: str,
    out: Path | None,
    host: str,
    port: int,
    timeout_s: float,
    fleet_name: str,
    dry_run: bool,
    printer: Printer,
) -> None:
    """Give a machine or a person a new key and certificate; your own are renewed at once.

    The old certificate stays valid until it ends or is revoked. A running agent finds its new key within a minute.

    \b
    Example:
        pancakes keys renew alice
        pancakes keys renew agent1
    """
    from pancakes.security.key_store import read_register

    folder = founded(fleet_name)
    entry = read_register(folder).latest(name, folder.name)
    if dry_run:
        _give_dry(folder.name, entry.role, entry.name, out, printer)
        return
    authority = opened(fleet_name)
    own = key_store.keys_of_person(authority.fleet)
    if out is None and entry.role in PEOPLE and own is not None and _bearer(own) == entry.name:
        authority.enrol_with_key(entry.role, entry.name, entry.groups).write(own)
        until = _date(authority.latest(name).ends_s)
        row = {"name": entry.name, "role": entry.role, "until": until, "done": "renewed"}
        printer.emit([row], f"You are {entry.role} {entry.name} of the fleet {authority.fleet} until {until}.")
    else:
        _give(authority, entry.role, entry.name, entry.groups, out, host, port, timeout_s, printer)


@keys.command()
@click.argument("code", metavar="CODE|FOLDER")
@may_be_dry
@format_option
def join(code: str, dry_run: bool, printer: Printer) -> None:
    """Make this machine or you a member of a fleet, with a code or a folder from its operator.

    \b
    Example:
        pancakes keys join 192.168.1.10:7490/HJOV-ZBJL-JECU-QFLF-4IQ3-JB24-L5EC-OS6P-LNXE-YAVB
        pancakes keys join agent2/
    """
    if Path(code).is_dir():
        files, made_here = _read(Path(code)), False
    else:
        with needing_extra("no fleet can be joined with a code"):
            from pancakes.security.enrolment import JoinCode
            from pancakes.security.enrolment import join as join_with
        if dry_run:
            parsed = JoinCode.parse(code)
            place = f"{parsed.host}:{parsed.port}"
            said = f"The machine at {place} would be asked; its answer has the fleet and the name."
            printer.emit([{"at": place, "done": DRY_RUN}], said)
            return
        files, made_here = _checked(join_with(code)), True
    folder = _folder_of(files)
    row = {"name": files.name, "role": files.role, "fleet": files.fleet, "keys": str(folder)}
    if dry_run:
        said = f"The keys of {files.role} {files.name} of the fleet {files.fleet} would be in {folder}."
        printer.emit([{**row, "done": DRY_RUN}], said)
        return
    files.write(folder)
    what = f"You are {files.role} {files.name}" if files.role in PEOPLE else f"This machine is {files.name}"
    made = "The key was created here and has not left this machine."
    copied = f"Remove {code} now, here and where it came from: it contains the private key."
    said = f"{what} of the fleet {files.fleet}: the keys are in {folder}."
    printer.emit([{**row, "done": "joined"}], said, made if made_here else copied)


@keys.command("list")
@of_fleet
@format_option
def list_(fleet_name: str, printer: Printer) -> None:
    """List the certificates that a fleet has issued.

    \b
    Example:
        pancakes keys list
    """
    from pancakes.security.key_store import read_register
    from pancakes.util.clock import wall_ns

    now_s = wall_ns() / 1e9
    rows = [
        {
            "name": it.name,
            "role": it.role,
            "groups": list(it.groups),
            "state": f"revoked: {it.revoked}" if it.revoked else "ended" if (it.ends_s or now_s) < now_s else "good",
            "since": _date(it.given_s),
            "ends": _date(it.ends_s),
            "came_from": it.came_from,
            "serial": it.serial,
        }
        for it in read_register(founded(fleet_name)).entries
    ]
    printer.table(rows, COLUMNS)


@keys.command()
@click.argument("who", metavar="NAME|ROLE/NAME")
@click.argument("why", metavar="REASON")
@of_fleet
@passes_it_on
@any_date_option
@yes_option
@click.option("--dry-run", is_flag=True, help="Only show what would be revoked.")
@format_option
def revoke(
    who: str,
    why: str,
    fleet_name: str,
    addresses: tuple[str, ...],
    timeout_s: float,
    any_date: bool,
    force: bool,
    dry_run: bool,
    printer: Printer,
) -> None:
    """Revoke all certificates of a machine or a person, because a robot or a laptop is lost, or a person has left.

    An agent that gets the new roster ends the member's links within a second, and passes the roster on. An agent that
    is away gets it when it is linked again. The exit code is 1 if no agent got the roster, or if an agent that was
    reached does not apply it; standard error has the reason.

    A revocation cannot be undone, so the command asks first; if this is not a terminal, --yes is required.

    \b
    Example:
        pancakes keys revoke operator/alice "laptop stolen"
        pancakes keys revoke agent1 "lost in the field" --at 192.168.1.23:7401
    """
    from pancakes.security.key_store import read_register

    why = " ".join(why.split())
    if not why:  # the register would count the certificate as good
        raise click.BadParameter("must say why, such as 'lost in the field'", param_hint="REASON")
    folder = founded(fleet_name)
    register = read_register(folder)
    bearer = register.latest(who, folder.name)
    if dry_run:
        _show_entries(register.of(who), DRY_RUN, printer)
        return
    confirm(f"this revokes {bearer.role}/{bearer.name} of the fleet {folder.name} for good", force)
    authority = opened(fleet_name)
    _show_entries(authority.revoke(who, why, any_date), "revoked", printer)
    spread(authority, addresses, timeout_s, printer, must_be_heard=True)


@keys.command()
@of_fleet
@passes_it_on
@any_date_option
@may_be_dry
@format_option
def sign(
    fleet_name: str, addresses: tuple[str, ...], timeout_s: float, any_date: bool, dry_run: bool, printer: Printer
) -> None:
    """Sign the roster of the fleet again, and pass it to the agents.

    The exit code is 1 if an agent that was reached does not apply it; standard error has the reason.

    \b
    Example:
        pancakes keys sign --at 192.168.1.23:7401
    """
    if dry_run:
        from pancakes.security.key_store import read_register, read_rules

        folder = founded(fleet_name)
        number, rules = read_register(folder).number + 1, len(read_rules(folder))
        row = {"fleet": folder.name, "roster": number, "rules": rules, "done": DRY_RUN}
        printer.emit([row], f"The roster {number} of the fleet {folder.name} would be signed, with {rules} rules.")
        return
    authority = opened(fleet_name)
    roster = authority.sign(any_date)
    row = {"fleet": authority.fleet, "roster": roster.number, "rules": len(roster.allow), "done": "signed"}
    printer.emit([row], f"The roster {roster.number} of the fleet {authority.fleet} is signed.")
    spread(authority, addresses, timeout_s, printer)


@keys.command()
@click.argument("who", metavar="WHO")
@click.argument("rights", metavar="RIGHT...", nargs=-1, required=True, type=click.Choice([*RIGHTS, EVERY]))
@click.option(
    "--on", metavar="PATTERN", multiple=True, help="What the rights are for. Repeatable. [default: everything]"
)
@click.option(
    "--agent", "at", metavar="PATTERN", multiple=True, help="At these agents. Repeatable. [default: all agents]"
)
@of_fleet
@passes_it_on
@any_date_option
@click.option("--dry-run", is_flag=True, help="Only show the rule.")
@format_option
def allow(
    who: str,
    rights: tuple[Right, ...],
    on: tuple[str, ...],
    at: tuple[str, ...],
    fleet_name: str,
    addresses: tuple[str, ...],
    timeout_s: float,
    any_date: bool,
    dry_run: bool,
    printer: Printer,
) -> None:
    """Give rights to members of the fleet: add a rule to rules.toml, and sign the roster.

    WHO is a name, a pattern of names, role:ROLE or group:GROUP. To take a right away, change rules.toml in the fleet's
    folder, and then: pancakes keys sign.

    \b
    Example:
        pancakes keys allow agent1 command --on motors --agent agent2
        pancakes keys allow group:field change --on '*/device/*'
    """
    rule = AccessRule((who,), rights, on or (EVERY,), at or (EVERY,))
    if not dry_run:
        authority = opened(fleet_name)
        authority.allow(rule, any_date)
    row = {"who": who, "may": list(rights), "on": list(rule.on), "at": list(rule.at)}
    printer.table([{**row, "done": DRY_RUN if dry_run else "allowed"}], (*row, "done"))
    if not dry_run:
        spread(authority, addresses, timeout_s, printer)


@keys.command()
@click.argument("who", metavar="NAME")
@click.argument("right", metavar="RIGHT", type=click.Choice(RIGHTS))
@click.argument("on", metavar="ON")
@click.option(
    "--agent", "at", default=EVERY, metavar="AGENT", help="At this agent. [default: at an agent that no rule names]"
)
@of_fleet
@format_option
def can(who: str, right: Right, on: str, at: str, fleet_name: str, printer: Printer) -> None:
    """Show whether a member of the fleet may do something, and by which rule.

    It uses the newest signed roster and asks no agent. The exit code is 1 if the answer is no.

    \b
    Example:
        pancakes keys can agent1 command motors --agent agent2
        pancakes keys can bob change 'agent1/device/ir' --agent agent1
    """
    from pancakes.security.key_store import ROSTER, read_register
    from pancakes.security.roster import read_signed

    folder = founded(fleet_name)
    roster = read_signed((folder / ROSTER).read_bytes())[1]
    entries = [it for it in read_register(folder).entries if who in (it.name, it.who)]
    if not entries:
        raise PancakesError(f"the register of the fleet {roster.fleet} has no {who}: see pancakes keys list")
    entry = entries[-1]
    if entry.revoked:
        raise PancakesError(f"no: {entry.who} was revoked: {entry.revoked}")
    bearer = Bearer(entry.name, entry.role, entry.groups)
    found = next((rule for rule in roster.allow if allows([rule], bearer, right, (on,), at)), None)
    if found is None:
        raise PancakesError(
            f"no: no rule of the roster {roster.number} gives {entry.who} the right {right!r} on {on!r}. To grant it:"
            f" pancakes keys allow {entry.name} {right} --on '{on}'" + (f" --agent {at}" if at != EVERY else "")
        )
    row = {"who": entry.who, "right": right, "on": on, "at": at, "roster": roster.number, "rule": _plain(found)}
    parts = [", ".join(found.who), "may", ", ".join(found.may), "on", ", ".join(found.on), "at", ", ".join(found.at)]
    printer.emit([row], f"yes: {' '.join(parts)} (roster {roster.number})")


# Shared by several verbs ----------------------------------------------------------------------------------------


def _give(
    authority: Authority,
    role: CertifiedRole,
    name: str,
    groups: Sequence[str],
    out: Path | None,
    host: str,
    port: int,
    timeout_s: float,
    printer: Printer,
) -> None:
    """Issue a certificate: into a folder, or to the machine that presents the code."""
    if out is not None:
        if out.exists() and any(out.iterdir()):
            raise PancakesError(f"the folder {out} is not empty")
        authority.enrol_with_key(role, name, groups).write(out)
        said = f"Copy {out} to {name} in a way that others cannot read. Then run there: pancakes keys join {out.name}"
        row = {"name": name, "role": role, "folder": str(out), "done": "written"}
        printer.emit([row], said, "It contains the private key: remove it here afterwards.")
        return
    from pancakes.mesh.address import is_loopback
    from pancakes.security.enrolment import Desk, own_address

    if not host and is_loopback(f"tcp://{(host := own_address())}:{port}"):
        said = "This machine has no network, so the code works only on this machine. To name an address, use --host."
        printer.note(said)
    desk = Desk(host, port, timeout_s)
    said = f"On {name}, within {_time_text(timeout_s)}:  pancakes keys join {desk.code}"
    printer.note(said)
    came_from = desk.serve(lambda key, place: authority.enrol(key, role, name, groups, came_from=place))
    row = {"name": name, "role": role, "came_from": came_from, "done": "joined"}
    printer.emit([row], f"{name} has joined from {came_from}.")


def _time_text(duration_s: float) -> str:
    return f"{duration_s:g} seconds" if duration_s < 120 else f"{duration_s / 60:.3g} minutes"


def _give_dry(fleet: str, role: CertifiedRole, name: str, out: Path | None, printer: Printer) -> None:
    """Print what `_give` would do, without asking for a password."""
    if out is not None and out.exists() and any(out.iterdir()):
        raise PancakesError(f"the folder {out} is not empty")
    place = f"a folder {out}" if out is not None else f"{name}, when it presents the code that is shown"
    row = {"name": name, "role": role, "fleet": fleet, "folder": str(out) if out is not None else "", "done": DRY_RUN}
    printer.emit([row], f"A certificate of {role} {name} of the fleet {fleet} would be issued to {place}.")


def _plain(rule: AccessRule) -> dict[str, list[str]]:
    return {"who": list(rule.who), "may": list(rule.may), "on": list(rule.on), "at": list(rule.at)}


def _read(folder: Path) -> KeyFiles:
    """Read a folder that `enrol --out` wrote and that was copied here.

    Raises:
        PancakesError: a file is missing, or the files do not fit together.
    """
    from pancakes.security.key_store import FLEET, KEY, ROSTER

    try:
        key, authority, roster = ((folder / file).read_bytes() for file in (KEY, FLEET, ROSTER))
    except OSError as error:
        raise PancakesError(f"{folder} is not a folder of pancakes keys enrol: {error.strerror or error}") from None
    return _checked(KeyFiles("", "", "", key, authority, roster))


def _checked(files: KeyFiles) -> KeyFiles:
    """Return the files with the fleet, the role and the name of their certificate.

    Raises:
        PancakesError: the files do not fit together.
    """
    from pancakes.security.keys import Keys

    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory) / "keys"
        files.write(folder)
        own = Keys(folder).own
    return files._replace(fleet=own.fleet, role=own.role, name=own.name)


def _folder_of(files: KeyFiles) -> Path:
    """Return the folder where keys belong.

    Raises:
        PancakesError: the folder has the keys of another person.
    """
    if files.role not in PEOPLE:
        return key_store.folder_of_agent(files.fleet, files.name)
    own = key_store.keys_of_person(files.fleet)
    if own is not None and (bearer := _bearer(own)) != files.name:
        raise PancakesError(f"you are {bearer} of the fleet {files.fleet} already: remove {own} first")
    return key_store.folder_of_person(files.fleet)


def _bearer(folder: Path) -> str:
    from pancakes.security.keys import Keys

    return Keys(folder).own.name


def _show_entries(entries: Sequence[Entry], done: str, printer: Printer) -> None:
    rows = [{"name": it.name, "role": it.role, "serial": it.serial, "done": done} for it in entries]
    printer.table(rows, ("name", "role", "serial", "done"))


def _own_name() -> str:
    import pwd

    try:
        name = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        name = ""
    if not name or fault_of_name(name):
        raise click.UsageError("pass your name with --me: the name of your user is not valid in a fleet")
    return name


def _date(time_s: float | None) -> str:
    if time_s is None:
        return "never"
    return datetime.datetime.fromtimestamp(time_s).strftime("%d %B %Y").lstrip("0")
