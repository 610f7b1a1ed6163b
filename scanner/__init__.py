"""The instrument: device, physics by stage, channels, recording and motion.

It imports none of the other packages: nothing in here estimates, simulates experiments or makes pictures.
"""

from pathlib import Path

from scanner.compiled_code import remove_outdated

remove_outdated(Path(__file__).parents[1])
