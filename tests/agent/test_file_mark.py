"""A file that was read is known to have changed by what is in it."""

import os

from pancakes.util.files import FileMark


def test_file_has_changed_only_if_it_says_something_else(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("[agent]\n")
    mark = FileMark(str(path))
    assert not mark.changed()
    os.utime(path, ns=(1, 1))
    assert not mark.changed(), "it was touched"
    path.write_text("[agent]\nname = 'a'\n")
    assert mark.changed()
    path.write_text("[agent]\n")
    assert not mark.changed(), "it is as it was"
    path.unlink()
    assert mark.changed()


def test_configuration_without_a_file_never_changes(tmp_path):
    assert not FileMark("").changed() and not FileMark(str(tmp_path / "none")).changed()
