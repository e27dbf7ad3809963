// Draw the equations that arithmatex has marked; see mkdocs.yml.
for (const node of document.querySelectorAll(".arithmatex")) {
  const text = node.textContent.trim();
  katex.render(text.slice(2, -2), node, { displayMode: text.startsWith("\\["), throwOnError: false });
}
