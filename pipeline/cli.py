"""The front door: what a person types."""

import click

from pipeline import __version__


@click.group()
@click.version_option(__version__, prog_name="gradetrace")
def main():
    """Turn the log of an excavator's cameras into poses and a trench report."""


if __name__ == "__main__":
    main()
