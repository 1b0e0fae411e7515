"""The public names: few, light to import, with examples that run."""

import doctest

import pytest

import dualdepth


def test_the_public_names_are_few_and_all_there():
    assert dualdepth.__all__ == ["DepthModel", "InputError", "load"]
    assert set(dualdepth.__all__) <= set(dir(dualdepth))
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        dualdepth.lode  # noqa: B018


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DepthModel", "load"])
def test_the_example_of_each_public_name_runs(name):
    found = doctest.DocTestFinder(recurse=False).find(getattr(dualdepth, name), name, globs={})
    assert sum(len(test.examples) for test in found) >= 2
    assert sum(doctest.DocTestRunner().run(test).failed for test in found) == 0
