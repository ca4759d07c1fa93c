"""``python -m pipeline`` is ``gradetrace``."""

from pipeline.cli import main

if __name__ == "__main__":
    main(prog_name="gradetrace")
