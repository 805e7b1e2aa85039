// What a plot shows as a file: its numbers, or its picture. Nothing leaves the page.

function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function csvText(plot) {
  const quoted = text => `"${text.replaceAll('"', '""')}"`;
  const unit = plot.scale === 1 ? plot.unit : "N";
  const head = ["frame", data.axis, ...plot.lines.map(line => `${line.label} (${unit})`), "status"];
  const rows = data.x.map((x, k) => [
    k, x, ...plot.lines.map(line => line.values[k] === null ? ""
      : Number((line.values[k] * plot.scale).toPrecision(5))), quoted(data.status[k]),
  ].join(","));
  return [head.map(quoted).join(","), ...rows, ""].join("\n");
}

function svgOf(figure) {
  const copy = figure.querySelector("svg").cloneNode(true), {width, height} = copy.viewBox.baseVal;
  for (const hidden of copy.querySelectorAll(".cursor, [style*='display: none']")) hidden.remove();
  copy.setAttribute("width", `${width}pt`);
  copy.setAttribute("height", `${height}pt`);
  copy.prepend(draw(copy, "rect", {width, height, fill: "#fff"}));
  draw(copy, "style", {}).textContent =
    "* { stroke-linejoin: round } text { font-family: 'DejaVu Sans', sans-serif }";
  return {text: new XMLSerializer().serializeToString(copy), width, height};
}

function savePng(name, figure) {
  const {text, width, height} = svgOf(figure), image = new Image(), dots = 4;  // per point: 288 dpi
  image.onload = () => {
    const canvas = document.createElement("canvas");
    canvas.width = dots * width;
    canvas.height = dots * height;
    const pen = canvas.getContext("2d");
    pen.drawImage(image, 0, 0, canvas.width, canvas.height);
    const drawn = figure.querySelector("canvas");
    if (drawn) {
      const [left, right, top, bottom] = figure.querySelector("svg").dataset.box.split(" ").map(Number);
      pen.drawImage(drawn, dots * left, dots * top, dots * (right - left), dots * (bottom - top));
    }
    canvas.toBlob(blob => save(`${name}.png`, blob), "image/png");
  };
  image.src = "data:image/svg+xml;charset=utf-8," + encodeURIComponent(text);
}

function addTools(figure) {
  const plot = plots.find(one => one.figure === figure);
  const name = `${data.name} ${figure.id.slice("figure-".length)}`.replace(/[^\w-]+/g, "_");
  const moving = figure.querySelector("canvas");
  const kinds = {PNG: () => savePng(moving ? `${name}_${slider.value}` : name, figure)};
  if (!moving) {  // a canvas is no part of the SVG
    kinds.SVG = () => save(`${name}.svg`, new Blob([svgOf(figure).text], {type: "image/svg+xml"}));
  }
  if (plot) kinds.CSV = () => save(`${name}.csv`, new Blob([csvText(plot)], {type: "text/csv"}));
  const tools = document.createElement("p");
  tools.className = "tools";
  for (const [kind, act] of Object.entries(kinds).reverse()) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = kind;
    button.title = `save as ${kind}`;
    button.addEventListener("click", act);
    tools.append(button);
  }
  figure.prepend(tools);
}
