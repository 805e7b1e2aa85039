// Forces in body weights or newtons: the curves stay, the vertical axis is written anew.

function roundStep(step) {
  const power = 10 ** Math.floor(Math.log10(step));
  return [1, 2, 2.5, 5, 10].map(one => one * power).find(one => one >= step * 0.999);
}

function newtonAxis(plot) {
  const [foot, head] = plot.svg.dataset.heights.split(" ").map(one => one * data.bodyWeight);
  const group = draw(plot.svg, "g", {});
  const step = roundStep((head - foot) / 6);
  for (let k = Math.ceil(foot / step); k * step <= head; k++) {
    const y = plot.bottom - (k * step - foot) / (head - foot) * (plot.bottom - plot.top);
    draw(group, "line", {x1: plot.left, x2: plot.right, y1: y, y2: y, stroke: "#e4e4e4",
                         "stroke-width": 0.7});
    draw(group, "line", {x1: plot.left - 3, x2: plot.left, y1: y, y2: y, stroke: "#1a1a1a",
                         "stroke-width": 0.8});
    draw(group, "text", {x: plot.left - 6, y: y + 3.2, "text-anchor": "end", "font-size": 9,
                         fill: "#1a1a1a"}).textContent = written(k * step, 0);
  }
  const middle = (plot.top + plot.bottom) / 2;
  draw(group, "text", {transform: `translate(9 ${middle}) rotate(-90)`, "text-anchor": "middle",
                       "font-size": 9, fill: "#1a1a1a"}).textContent = "N";
  return group;
}

function inNewtons(wanted) {
  for (const plot of plots.filter(one => one.unit === "BW")) {
    const axis = plot.svg.querySelector(`[id="${plot.name}-matplotlib.axis_2"]`);
    if (!plot.newtons) {
      plot.newtons = newtonAxis(plot);
      axis.before(plot.newtons);
    }
    axis.style.display = wanted ? "none" : "";
    plot.newtons.style.display = wanted ? "" : "none";
    plot.scale = wanted ? data.bodyWeight : 1;
    plot.figure.querySelector("h3 small").textContent = wanted ? "(N)" : "(BW)";
  }
  show(Number(slider.value));
}

for (const button of document.querySelectorAll("#bar input[name=unit]")) {
  button.addEventListener("change", () => inNewtons(button.value === "N"));
}
