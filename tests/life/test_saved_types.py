"""What a class that is saved may be made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest
from msgspec import Meta

from pancakes.errors import ClassError
from pancakes.supervision.serializable_types import check_saved, fault_of_type


@dataclass
class Leg:
    length_m: Annotated[float, Meta(gt=0)] = 1.0
    shared: ClassVar[Any] = None
    plain: ClassVar = object()


@dataclass
class Loose:
    shared: ClassVar[int] = 0
    held: Any = None


@dataclass
class Numbered:
    n: Annotated[np.float64, "of numpy"]


@dataclass
class Wrong:
    later: "Leg" | None = None  # noqa: UP037  # at run time Python makes no type of that
    held: Any = None


@pytest.mark.parametrize("kind", [Leg, list[Leg], dict[str, Leg], Leg | None])
def test_what_belongs_to_the_class_is_not_saved_and_may_be_anything(kind: Any) -> None:
    assert fault_of_type(kind) == ""


def test_a_field_within_a_field_is_named() -> None:
    assert fault_of_type(list[Loose]).startswith("is made of Loose, whose held may be anything")
    assert fault_of_type(Numbered).startswith("is made of Numbered, whose n is a float64 of numpy")


def test_an_annotation_that_is_no_type_is_told_of_and_the_others_are_judged_too() -> None:
    class Owner:
        State = Wrong

    with pytest.raises(ClassError) as refused:
        check_saved(Owner, "State")
    later, held = str(refused.value).splitlines()
    assert "Owner.State.later has a type that cannot be checked when it is read again: unsupported operand" in later
    assert "Owner.State.held may be anything" in held
