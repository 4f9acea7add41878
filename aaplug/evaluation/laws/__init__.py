"""Laws of everything that a package can add: functions that raise where an object breaks them.

`aaplug check-plugin` runs them on a package's objects, and the tests on all that are registered.  A broken law is an
AssertionError; a law can also end in any exception that the object raises.
"""

from . import drawing, files, filters, recipes  # these enter their laws
from .base import LAWS
