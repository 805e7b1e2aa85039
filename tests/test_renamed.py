"""Renamed Python names of the last release still work, with a warning."""

import importlib
import pickle

import pytest

from tkamb.errors import InputError


def test_the_hint_of_an_error_is_accepted_under_its_former_name():
    with pytest.warns(DeprecationWarning, match="hint"):
        error = InputError("what", "where", mend="do this")
    assert str(error) == str(InputError("what", "where", "do this")) == "where: what; do this"
    with pytest.warns(DeprecationWarning, match="hint"):
        assert error.mend == error.hint == "do this"
    assert pickle.loads(pickle.dumps(error)).hint == "do this"


@pytest.mark.parametrize(
    ("module", "former", "name"),
    [
        ("tkamb.run.workers", "Crew", "PoolOptions"),
        ("tkamb.run.workers", "Team", "WorkerPool"),
    ],
)
def test_a_renamed_class_is_found_under_its_former_name(module, former, name):
    module_object = importlib.import_module(module)
    with pytest.warns(DeprecationWarning, match=name):
        assert getattr(module_object, former) is getattr(module_object, name)
    with pytest.raises(AttributeError, match="nothing_of_this"):
        _ = module_object.nothing_of_this
