// Numbers as CSV and charts as SVG: a button beside each table and chart.
(() => {
  const save = (name, type, text) => {
    const link = element("a", { download: name, href: URL.createObjectURL(new Blob([text], { type })) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const titleOf = (node) => {
    const heading = [...document.querySelectorAll("main h2")].filter((each) => each.compareDocumentPosition(node) & 4).pop();
    return (heading?.textContent ?? document.title).trim().toLowerCase().replace(/[^a-z0-9]+/g, "_");
  };
  const button = (label, act) => {
    const node = element("button", { type: "button", className: "download", textContent: label });
    node.addEventListener("click", act);
    return node;
  };
  for (const table of document.querySelectorAll("main table")) {
    const cell = ({ textContent }) => `"${textContent.replaceAll('"', '""')}"`;
    const text = () => [...table.rows].map((row) => [...row.cells].map(cell).join(",")).join("\r\n");
    table.parentElement.after(button("CSV", () => save(`${titleOf(table)}.csv`, "text/csv", `\ufeff${text()}`)));
  }
  for (const chart of document.querySelectorAll(".charts svg")) {
    const colours = getComputedStyle(document.documentElement);
    const text = () => new XMLSerializer().serializeToString(chart).replace(/var\((--[a-z]+)\)/g, (_, name) => colours.getPropertyValue(name));
    const place = element("div");
    chart.replaceWith(place);
    place.append(chart, button("SVG", () => save(`${titleOf(place)}.svg`, "image/svg+xml", text())));
  }
})();
