"""Hooks of the documentation site, which add pages to those under docs/.

`CONTRIBUTING.md` and `CHANGELOG.md` of the repository become pages, the examples one
page with their code, notebooks pages with their outputs, formulas MathML. Links out of
docs/ in the repository point to those pages on the site.
"""

import re
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[2]
OF_THE_REPOSITORY = ("CONTRIBUTING.md", "CHANGELOG.md")
# Pages that may be missing.
OPTIONAL = ("results.md", "results_detail.md", "reliability.md", "imitation.md")
# A table with this many columns replaces the page's table of contents.
_WIDE = 5
# Most characters of a word of code that is kept on one line.
_WHOLE = 26
# A link out of docs/ to a page of the site.
_LINK = re.compile(r"\]\((?:\.\./)*(docs/|examples/)?([\w./-]*)(#[\w-]*)?\)")
# Formulas in TeX, as on GitHub: on separate lines, and inline.
_DISPLAYED = re.compile(r"(?ms)^```math\n(.*?)\n```$")
_INLINE = re.compile(r"\$`([^`\n]+)`\$")
# Blanks in a table at which a line may not break; inline code.
_UNIT = re.compile(r"(?<=\d) (?=(?:%|°|[µmk]?[mNs]|M?B)(?![\w/·]))|(?<=[±≤≥]) | (?=±)")
_CODE = re.compile(r"<pre.*?</pre>|<code>([^<]+)</code>", re.DOTALL)


def on_config(config):
    """Removes missing pages from the menu."""
    config.nav = _present(config.nav, Path(config.docs_dir))
    return config


def _present(entries, folder):
    found = []
    for entry in entries:
        if isinstance(entry, dict):
            [(title, target)] = entry.items()
            if isinstance(target, list):
                entry = {title: _present(target, folder)}
            elif target in OPTIONAL and not (folder / target).exists():
                continue
        found.append(entry)
    return found


def on_files(files, config):
    """Adds the generated pages."""
    for name in OF_THE_REPOSITORY:
        text = (ROOT / name).read_text()
        files.append(File.generated(config, name, content=text))
    files.append(File.generated(config, "examples.md", content=_examples()))
    for notebook in sorted((Path(config.docs_dir) / "tutorials").glob("*.ipynb")):
        source = f"tutorials/{notebook.name}"
        files.remove(files.get_file_from_path(source))
        for name, content in _notebook(notebook).items():
            files.append(File.generated(config, name, content=content))
    config.nav = _as_pages(config.nav)
    return files


def _as_pages(entries):
    """The menu with the page of each notebook instead of the notebook."""
    if isinstance(entries, list):
        return [_as_pages(entry) for entry in entries]
    if isinstance(entries, dict):
        return {title: _as_pages(target) for title, target in entries.items()}
    return entries.replace(".ipynb", ".md")


def on_page_markdown(markdown, page, config, files):
    """Points links out of docs/ to pages of the site; hides the menu at wide tables."""
    del config, files
    rows = re.findall(r"^\|[-|: ]+\|$", markdown, re.MULTILINE)
    if any(row.count("|") - 1 >= _WIDE for row in rows):
        page.meta.setdefault("hide", ["toc"])
    up = "../" * page.file.src_uri.count("/")

    def lead(match: re.Match) -> str:
        folder, target, anchor = match.group(1), match.group(2), match.group(3) or ""
        if folder == "examples/":
            return f"]({up}examples.md#{Path(target).stem.replace('_', '-')})"
        if folder == "docs/":
            return f"]({up}{target}{anchor})"
        if Path(target).name in OF_THE_REPOSITORY:
            return f"]({up}{Path(target).name}{anchor})"
        return match.group(0).replace(".ipynb", ".md")

    markdown = _formulas(markdown)
    markdown = re.sub(r"(?m)^\|.*$", lambda row: _row(row[0]), markdown)
    return _LINK.sub(lead, markdown)


def _formulas(markdown: str) -> str:
    """Replaces formulas by MathML, which browsers draw without a script."""
    shown = r'<div class="formula">{}</div>'
    markdown = _DISPLAYED.sub(
        lambda tex: shown.format(convert(tex[1], display="block")), markdown
    )
    return _INLINE.sub(lambda tex: convert(tex[1]), markdown)


def _row(line: str) -> str:
    """A row of a table without line breaks between a value and its unit."""
    parts = line.split("`")  # code stays unchanged, as readers copy it
    for i in range(0, len(parts), 2):
        text = parts[i].replace("<= ", "≤ ").replace(">= ", "≥ ")
        text = _UNIT.sub("\N{NO-BREAK SPACE}", text)
        text = re.sub(r"(?<=\d)–(?=\d)", "–\N{WORD JOINER}", text)
        text = re.sub(r"(?<=\d)-(?=\d\d\b)", "\N{NON-BREAKING HYPHEN}", text)
        parts[i] = text
    return "`".join(parts)


def on_page_content(html, page, config, files):
    """Keeps words of inline code, such as options and task names, on one line."""
    del page, config, files

    def whole(code: re.Match) -> str:
        if code[1] is None:
            return code[0]
        words = (
            f'<span class="whole">{word}</span>' if len(word) <= _WHOLE else word
            for word in code[1].split(" ")
        )
        return f"<code>{' '.join(words)}</code>"

    return _CODE.sub(whole, html)


def _examples() -> str:
    """Page of the examples with their code."""
    parts = ["# Examples", "", "Files under `examples/` of the repository.", ""]
    for path in sorted((ROOT / "examples").glob("*.py")):
        anchor = path.stem.replace("_", "-")
        parts += [f"## `{path.name}` {{ #{anchor} }}", ""]
        parts += ["```python", path.read_text().rstrip(), "```", ""]
    return "\n".join(parts)


def _notebook(path: Path) -> dict[str, str | bytes]:
    """The page of a notebook and its pictures, by path on the site."""
    notebook = nbformat.read(path, as_version=4)
    # The cell that installs in Colab is left out.
    notebook.cells = [cell for cell in notebook.cells if cell.get("id") != "colab"]
    exporter = MarkdownExporter()
    text, resources = exporter.from_notebook_node(notebook)
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    # A comment separates two outputs of a cell, which Markdown would merge.
    text = re.sub(r"(?m)(^    .*\n)\n{3,}(?=    )", r"\1\n<!-- -->\n\n", text)
    pages: dict[str, str | bytes] = {}
    for name, content in resources.get("outputs", {}).items():
        picture = f"{path.stem}_{name}"
        text = text.replace(f"({name})", f"({picture})")
        pages[f"tutorials/{picture}"] = content
    source = f"*This page is the notebook `docs/tutorials/{path.name}`.*"
    first, rest = text.lstrip().split("\n", 1)
    pages[f"tutorials/{path.stem}.md"] = f"{first}\n\n{source}\n{rest}"
    return pages
