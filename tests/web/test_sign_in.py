"""Who may open a page beyond the loopback interface: passwords, cookies, host names."""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path

import pytest

from pancakes.errors import PancakesError
from pancakes.tools.web.exposure import Exposure, checked_names, is_loopback, password_in
from pancakes.tools.web.sign_in import (
    LONGEST,
    MOST_ADDRESSES,
    MOST_WRONG,
    MOST_WRONG_OF_ALL,
    SIGNED_IN_S,
    WINDOW_S,
    SignIn,
    fault_of_password,
    is_own_name,
)

PASSWORD = "correct hörse"
RIGHT = b64encode(PASSWORD.encode()).decode()
WRONG = b64encode(b"something else").decode()


@pytest.fixture
def sign_in() -> SignIn:
    return SignIn(PASSWORD, "secret", "page")


def cookie_of(header: str) -> str:
    return header.partition(";")[0]


def test_only_the_right_password_is_right(sign_in: SignIn):
    assert sign_in.is_right(RIGHT, "10.0.0.1", 0.0)
    for given in ("", WRONG, RIGHT[:-4], "é", PASSWORD, "=" * 20, b64encode(b"x" * 5000).decode()):
        assert not SignIn(PASSWORD, "secret", "page").is_right(given, "10.0.0.1", 0.0), given


def test_wrong_passwords_of_one_address_are_limited(sign_in: SignIn):
    for number in range(MOST_WRONG):
        assert sign_in.pause_s("10.0.0.1", float(number)) == 0.0
        assert not sign_in.is_right(WRONG, "10.0.0.1", float(number))
    assert sign_in.pause_s("10.0.0.1", 5.0) == pytest.approx(WINDOW_S - 5.0)
    assert sign_in.pause_s("10.0.0.2", 5.0) == 0.0
    assert sign_in.pause_s("10.0.0.1", WINDOW_S) == 0.0


def test_addresses_of_one_machine_count_together(sign_in: SignIn):
    for number in range(MOST_WRONG):
        sign_in.is_right(WRONG, f"fe80::{number}%eth0", 0.0)
        sign_in.is_right(WRONG, "::ffff:10.0.0.1", 0.0)
    assert sign_in.pause_s("fe80::99%eth0", 1.0) > 0.0 and sign_in.pause_s("fe81::1", 1.0) == 0.0
    assert sign_in.pause_s("10.0.0.1", 1.0) > 0.0


def test_wrong_passwords_of_all_addresses_are_limited(sign_in: SignIn):
    for number in range(MOST_WRONG_OF_ALL):
        sign_in.is_right(WRONG, f"10.0.{number}.1", 0.0)
    assert sign_in.pause_s("10.9.9.9", 1.0) > 0.0
    for number in range(3 * MOST_ADDRESSES):
        sign_in.is_right(WRONG, f"10.{number % 256}.{number // 256}.2", 2.0)
    assert sign_in.addresses == MOST_ADDRESSES


def test_right_password_forgives_the_wrong_ones(sign_in: SignIn):
    for _ in range(MOST_WRONG - 1):
        sign_in.is_right(WRONG, "10.0.0.1", 0.0)
    assert sign_in.is_right(RIGHT, "10.0.0.1", 0.0)
    sign_in.is_right(WRONG, "10.0.0.1", 0.0)
    assert sign_in.pause_s("10.0.0.1", 1.0) == 0.0


def test_cookie_is_valid_until_it_expires_or_the_password_changes(sign_in: SignIn):
    made = sign_in.new_cookie(1000.0, secure=True)
    assert "HttpOnly; SameSite=Strict; Secure" in made and f"Max-Age={SIGNED_IN_S}" in made
    assert "Secure" not in sign_in.new_cookie(1000.0, secure=False)
    cookie = cookie_of(made)
    assert sign_in.knows([f"other=1; {cookie}"], 1001.0)
    assert SignIn(PASSWORD, "secret", "page").knows([cookie], 1001.0), "also after a restart"
    assert not sign_in.knows([cookie], 1000.0 + SIGNED_IN_S)
    assert not SignIn("another password", "secret", "page").knows([cookie], 1001.0)
    assert not SignIn(PASSWORD, "another secret", "page").knows([cookie], 1001.0)
    assert not SignIn(PASSWORD, "secret", "other page").knows([cookie], 1001.0)


def test_made_up_cookies_are_refused(sign_in: SignIn):
    expires, _, signature = cookie_of(sign_in.new_cookie(1000.0, False)).removeprefix("page=").partition(".")
    later = f"page={int(expires) + 1}.{signature}"
    for cookie in ("", "page=", "page=1", f"page={'9' * 400}.{signature}", f"page=.{signature}", later, "page=é.x"):
        assert not sign_in.knows([cookie], 1001.0), cookie
    assert not sign_in.knows([], 1001.0)


def test_passwords_have_a_least_length():
    assert "at least 8 characters" in fault_of_password("1234567")
    assert "at most" in fault_of_password("é" * LONGEST)
    assert fault_of_password("12345678") == ""


def test_password_file_must_be_private_and_readable(tmp_path: Path):
    file = tmp_path / "password"
    file.write_text(f"{PASSWORD}\nsecond line\n")
    file.chmod(0o644)
    with pytest.raises(PancakesError, match="other users can read the password in .*: chmod 600"):
        password_in(file)
    file.chmod(0o600)
    assert password_in(file) == PASSWORD
    file.write_bytes(b"\xff\xfe\xff\xff\xff\xff\xff\xff\xff")
    with pytest.raises(PancakesError, match="not text in UTF-8"):
        password_in(file)
    file.write_text("\n")
    with pytest.raises(PancakesError, match="at least 8 characters, this one has 0"):
        password_in(file)
    with pytest.raises(PancakesError, match="cannot be read from .*: No such file"):
        password_in(tmp_path / "nothing")


def test_host_names_of_other_sites_are_refused():
    names = Exposure("Robot1.lab", PASSWORD, ("extra.example",)).all_names()
    for host in ("robot1.lab", "ROBOT1.LAB:7480", "robot1.lab.", "extra.example", "localhost:1", "10.0.0.5:7480"):
        assert is_own_name([host], names), host
    for host in ("[::1]:7480", "192.168.1.1", "[fe80::1]"):
        assert is_own_name([host], names), "a browser sends an address only if a person opened that address"
    for host in ("", "evil.example", "robot1.lab.evil.example", "10.0.0.5.evil.example", "robot1.lab:7480:1", "a b"):
        assert not is_own_name([host], names), host
    assert not is_own_name([], names) and not is_own_name(["robot1.lab", "robot1.lab"], names)


def test_address_of_a_page_has_a_name_that_others_can_open():
    assert Exposure("::1", PASSWORD).shown_name() == "[::1]"
    assert Exposure("10.0.0.5", PASSWORD).shown_name() == "10.0.0.5"
    assert Exposure("0.0.0.0", PASSWORD).shown_name() not in ("0.0.0.0", "")
    assert is_loopback("127.0.0.9") and is_loopback("localhost") and is_loopback("::1")
    assert not is_loopback("0.0.0.0") and not is_loopback("robot1")
    with pytest.raises(PancakesError, match="is not a host name: write it without scheme and port"):
        checked_names(["http://robot1"])
