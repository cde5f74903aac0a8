// Typesets the mathematics of a page when it is shown. Everything it needs is in this folder.
document.addEventListener("DOMContentLoaded", () => {
  for (const one of document.querySelectorAll(".arithmatex")) {
    const text = one.textContent.trim();
    const display = text.startsWith("\\[");
    katex.render(text.slice(2, -2), one, { displayMode: display, throwOnError: false });
  }
});
