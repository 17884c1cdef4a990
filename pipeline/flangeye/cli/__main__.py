"""``python -m flangeye.cli`` is ``flangeye``."""

from flangeye.cli import main

main()
