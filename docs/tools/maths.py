"""A Markdown extension that turns the formulas of the pages into MathML: no script, no font, no other host, and read aloud.

``pymdownx.arithmatex`` finds the formulas, between ``$`` or ``$$``; this sets them.
"""

from xml.etree.ElementTree import Element

from latex2mathml.converter import convert
from markdown import Extension, Markdown
from markdown.treeprocessors import Treeprocessor

AFTER_INLINE = 5  # formulas within a sentence are found at priority 20


class MathsTreeprocessor(Treeprocessor):
    """Replaces each formula's LaTeX by MathML."""

    def run(self, root: Element) -> None:
        """Set all formulas of a page; one that can't be set ends the build."""
        for element in root.iter():
            if element.get("class") == "arithmatex":
                display = "block" if element.tag == "div" else "inline"
                mathml = convert("".join(element.itertext()), display=display)
                for child in list(element):
                    element.remove(child)
                element.text = self.md.htmlStash.store(mathml)


class MathsExtension(Extension):
    """Sets the formulas that ``pymdownx.arithmatex`` (generic, without wraps) found."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Add the step to a page's way."""
        md.treeprocessors.register(MathsTreeprocessor(md), "gonio-maths", AFTER_INLINE)


def makeExtension(**options: object) -> MathsExtension:
    """Make the extension; its name is Markdown's convention."""
    return MathsExtension(**options)
