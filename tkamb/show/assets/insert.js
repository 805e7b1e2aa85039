// The pressure map of the slider's frame, drawn on a canvas over the picture of the insert.

function insertMap(figure, maps) {
  const svg = figure.querySelector("svg"), canvas = document.createElement("canvas");
  const words = figure.querySelector(".readout"), view = svg.viewBox.baseVal;
  const [left, right, top, bottom] = svg.dataset.box.split(" ").map(Number);
  const [west, east, south, north] = maps.span;
  const dots = 12;  // of the canvas per mm
  canvas.width = Math.round((east - west) * dots);
  canvas.height = Math.round((north - south) * dots);
  Object.assign(canvas.style, {
    left: `${100 * left / view.width}%`, top: `${100 * top / view.height}%`,
    width: `${100 * (right - left) / view.width}%`,
    height: `${100 * (bottom - top) / view.height}%`,
  });
  svg.parentNode.append(canvas);
  const pen = canvas.getContext("2d"), {rows, columns, rim} = maps;
  const [first, last, low, high] = maps.edges;
  const across = x => (x - first) / (last - first) * (columns - 1);  // mm on the page to tile
  const down = y => (high - y) / (high - low) * (rows - 1);
  const colour = k => [0, 2, 4].map(at => parseInt(maps.colours.substr(6 * k + at, 2), 16));
  const colours = Array.from({length: 256}, (_, k) => colour(k));
  let bytes = null, sheet = 0, tile = 0;

  function level(x, y) {  // a byte between the tile's points, linear; 0 outside
    const i = Math.floor(y), j = Math.floor(x), v = y - i, u = x - j;
    if (i < 0 || j < 0 || i >= rows - 1 || j >= columns - 1) return 0;
    const at = (Math.floor(tile / maps.across) * rows + i) * sheet
      + (tile % maps.across) * columns + j;
    return (1 - v) * ((1 - u) * bytes[at] + u * bytes[at + 1])
      + v * ((1 - u) * bytes[at + sheet] + u * bytes[at + sheet + 1]);
  }

  function paint(frame) {
    if (!bytes) return;
    tile = maps.tile[frame];
    const {width, height} = canvas, image = pen.createImageData(width, height);
    for (let row = 0; row < height; row++) {
      const y = down(north - (row + 0.5) / dots);
      for (let column = 0; column < width; column++) {
        const found = level(across(west + (column + 0.5) / dots), y);
        if (found <= rim) continue;
        const at = 4 * (row * width + column);
        const shade = colours[Math.round((found - rim) / (255 - rim) * 255)];
        for (let k = 0; k < 3; k++) image.data[at + k] = shade[k];
        image.data[at + 3] = Math.min(255, 100 * (found - rim));
      }
    }
    pen.putImageData(image, 0, 0);
    for (const side of Object.values(maps.centres)) cross(side[maps.shown[frame]]);
    const shown = maps.shown[frame];
    words.textContent = data.place[shown] + (shown === frame ? "" : ", the nearest map");
  }

  function cross(centre) {
    if (!centre) return;
    const x = (centre[0] - west) * dots, y = (north - centre[1]) * dots;
    for (const [width, shade] of [[7, "#fff"], [3, "#1a1a1a"]]) {
      pen.lineWidth = width;
      pen.strokeStyle = shade;
      pen.beginPath();
      pen.moveTo(x - 14, y); pen.lineTo(x + 14, y); pen.moveTo(x, y - 14); pen.lineTo(x, y + 14);
      pen.stroke();
    }
  }

  canvas.addEventListener("pointermove", event => {
    const box = canvas.getBoundingClientRect();
    const x = west + (event.clientX - box.left) / box.width * (east - west);
    const y = north - (event.clientY - box.top) / box.height * (north - south);
    const share = Math.max(0, level(across(x), down(y)) - rim) / (255 - rim);
    const there = share > 0 ? `about ${(share * maps.largest).toFixed(1)} MPa` : "no contact";
    words.textContent = `${data.place[maps.shown[Number(slider.value)]]}; here: ${there}`;
  });
  canvas.addEventListener("pointerleave", () => paint(Number(slider.value)));
  const picture = new Image();
  picture.onload = () => {
    const board = document.createElement("canvas");
    board.width = sheet = picture.width;
    board.height = picture.height;
    const ink = board.getContext("2d");
    ink.drawImage(picture, 0, 0);
    bytes = ink.getImageData(0, 0, board.width, board.height).data.filter((_, k) => k % 4 === 0);
    paint(Number(slider.value));
    figure.dataset.ready = "yes";
  };
  picture.src = maps.picture;
  figure.hidden = false;
  watchers.push(paint);
}
