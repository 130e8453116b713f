// Builds the table of contents and starts every widget; a widget that fails says so in its place.
(() => {
  const contents = document.querySelector(".contents");
  for (const [number, heading] of [...document.querySelectorAll("main h2")].entries()) {
    heading.id = `part-${number + 1}`;
    const fold = heading.closest("details");
    const link = element("a", { href: `#${heading.id}`, textContent: heading.textContent });
    if (fold) link.addEventListener("click", () => { fold.open = true; });
    contents.append(link);
  }
  const start = async () => {
    for (const root of document.querySelectorAll("figure[data-widget]")) {
      const stored = root.querySelector("script[type='application/json']");
      try {
        await widgets[root.dataset.widget](root, JSON.parse(stored.textContent));
      } catch (error) {
        root.prepend(element("p", { className: "note", textContent: `This picture could not be shown: ${error.message}` }));
        console.error(error);
      }
      stored.remove();
    }
    document.documentElement.dataset.ready = "true";
  };
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((fold) => { fold.open = true; }));
  start();
})();
