"""What several test files share; pytest explains failing assertions in here as it does in the tests themselves."""

import pkgutil

import pytest

pytest.register_assert_rewrite(*(f"{__name__}.{module.name}" for module in pkgutil.iter_modules(__path__)))
