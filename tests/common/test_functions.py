"""Functions that are given themselves or by their dotted names."""

import pytest
import toy

from sb3_sap.common.functions import resolve


def test_resolve_returns_functions_and_imports_names():
    assert resolve(toy.nearby, "ap_function") is toy.nearby
    assert resolve("toy.towards_centre", "ap_function") is toy.towards_centre


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (3, TypeError, r"`ap_function` must be a function or its dotted name .*, but is 3"),
        ("towards_centre", TypeError, r"`ap_function` must be a function or its dotted name .*'towards_centre'"),
        ("no_such_package.function", ValueError, r"`ap_function`: 'no_such_package.function' cannot be imported"),
        ("toy.no_such_function", ValueError, r"`ap_function`: 'toy.no_such_function' cannot be imported"),
        (".towards_centre", TypeError, r"`ap_function` must be a function or its dotted name .*'.towards_centre'"),
        ("toy.", TypeError, r"`ap_function` must be a function or its dotted name .*'toy.'"),
        ("toy.NOT_A_FUNCTION", TypeError, r"`ap_function`: 'toy.NOT_A_FUNCTION' names a int, but must name a function"),
    ],
)
def test_resolve_refuses_what_is_no_function(given, error, message):
    with pytest.raises(error, match=message):
        resolve(given, "ap_function")
