"""What the site's build checks and mends beyond mkdocs: the reference is complete, no page asks another host."""

import ast
import logging
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
log = logging.getLogger("mkdocs.hooks.jaxtri")

_MERMAID = re.compile(r'<script type="module">(?:(?!</script>).)*mermaid(?:(?!</script>).)*</script>', re.DOTALL)
_MATHJAX = re.compile(r"<!-- Load mathjax -->.*?<!-- End of mathjax configuration -->", re.DOTALL)
_FORMULA = re.compile(r"(?<![\\$\w])\$([^$<>\n]{1,60})\$(?!\w)")
# jaxtyping's shapes as they were written: a string, without the leading blank that is for linters.
_LENGTH = re.compile(r'((?:Array|ndarray)</span><span class="p">,</span> <span class=")mi">(\d+)</span>')
_SHAPE = re.compile(r"""<span class="s[12]">(?:&quot;|&#39;|"|') ?([^&"'<]*)(?:&quot;|&#39;|"|')</span>""")
_LISTED = re.compile(r"""((?:Array|ndarray)</span>, )(?:(?:&#39;|') ?([^&'<]*)(?:&#39;|')|(\d+))(?=\])""")
_ELSEWHERE = re.compile(r'<(?:script|link|img)[^>]*\s(?:src|href)="(?:https?:)?//[^"]+"')


def on_files(files, config):
    """Warn, which `strict` makes an error, of public names that the reference leaves out."""
    tree = ast.parse((ROOT / "jaxtri" / "__init__.py").read_text())
    public = next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__"
    )
    pages = "\n".join(p.read_text() for p in sorted((ROOT / "docs" / "reference").glob("*.md")))
    said = {name.rsplit(".", 1)[-1] for name in re.findall(r"^::: (\S+)", pages, re.MULTILINE)}
    for name in sorted(set(public) - said):
        log.warning("the reference has no entry for jaxtri.%s", name)
    return files


def on_post_page(output, page, config):
    """Notebooks without scripts from elsewhere: their few formulas are set here, and there are no diagrams."""
    if page.file.src_uri.startswith("notebooks/"):
        output = _MERMAID.sub("", _MATHJAX.sub("", output))
        output = _FORMULA.sub(_formula, output)
    if page.file.src_uri.startswith("reference/"):
        output = _LENGTH.sub(r'\1s2">&quot;\2&quot;</span>', output)
        output = _LISTED.sub(lambda m: f"{m[1]}&quot;{m[2] or m[3] or ''}&quot;", output)
        output = _SHAPE.sub(r'<span class="s2">&quot;\1&quot;</span>', output)
    if found := _ELSEWHERE.search(output):
        log.warning("%s loads from another host: %s", page.file.src_uri, found[0])
    return output


def _formula(match: re.Match) -> str:
    text = match[1].replace("\\\\", "\\").replace("\\sigma", "\N{GREEK SMALL LETTER SIGMA}")
    text = re.sub(r"\^(\w)", r"<sup>\1</sup>", text)
    return f"<em>{text}</em>"
