"""Writes the pages of the documentation that come from the code: `make reference`."""

from documentation.reference_pages import PAGES


def main() -> None:
    """Writes every page and names those that have changed."""
    for path, write in PAGES.items():
        text = write()
        changed = not path.is_file() or path.read_text(encoding="utf-8") != text
        path.write_text(text, encoding="utf-8")
        print(f"{'written' if changed else 'up to date'}: {path}")


if __name__ == "__main__":
    main()
