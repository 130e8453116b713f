// A tilt series as a film: data against prediction under a swipe, what is left, and one row in all tilts.
widgets.tilts = async (root, options) => {
  const { sprites, angles, limits, names, unit, pixelSize } = options;
  const data = await unpack(sprites);
  const [sections, height, width] = sprites.shape;
  const count = sections / 2, size = height * width;
  let tilt = options.start, row = height >> 1, curve = contrastCurve(0, 255);

  const [before, after, left, sinogram] = Array.from({ length: 4 }, () => element("canvas"));
  before.ariaLabel = names[0];
  after.ariaLabel = names[1];
  after.className = "over";
  const swipe = element("input", { type: "range", className: "swipe", min: 0, max: 100, step: 0.5, ariaLabel: "swipe" });
  const line = element("i", { className: "swipe-line" });
  const tags = names.map((name, side) => element("span", { className: `tag ${side ? "right" : "left"}`, textContent: name }));
  const stage = stageOf(width, height, before, after, swipe, line, ...tags, scaleBar(width, pixelSize));
  const split = () => stage.style.setProperty("--split", `${swipe.value}%`);
  swipe.value = 50;
  swipe.addEventListener("input", split);
  split();

  // what is left, grey where nothing is, black and white at four times its rms; at least a grey value a step
  let squares = 0;
  for (let index = 0; index < count * size; index++) squares += (data[index] - data[index + count * size]) ** 2;
  const reach = Math.min(128, Math.max(4, 4 * Math.sqrt(squares / (count * size)))), gain = 128 / reach;
  const span = Number((reach * (sprites.high - sprites.low) / 255).toPrecision(2));
  const residual = (index) => {
    const shade = Math.min(255, Math.max(0, Math.round(128 + gain * (data[index] - data[index + count * size]))));
    return (255 << 24 | shade << 16 | shade << 8 | shade) >>> 0;
  };
  const drawRow = () => paint(sinogram, width, count, row * width, 1, size, residual);
  const draw = () => {
    paint(before, width, height, tilt * size, 1, width, (i) => curve[data[i]]);
    paint(after, width, height, (count + tilt) * size, 1, width, (i) => curve[data[i]]);
    paint(left, width, height, tilt * size, 1, width, residual);
  };

  const control = slider("tilt", {
    min: 0, max: count - 1, value: tilt, text: (index) => `${angles[index].toFixed(1)}°`,
    change: (index) => { tilt = index; motion.stop(); draw(); },
  });
  let direction = 1;
  const motion = player(stage, "tilts", 90, () => {
    if (tilt + direction < 0 || tilt + direction >= count) direction = -direction;
    tilt = Math.min(count - 1, Math.max(0, tilt + direction));
    control.set(tilt);
    draw();
  }, false);
  const rowControl = slider("row", { min: 0, max: height - 1, value: row, change: (index) => { row = index; drawRow(); } });
  const contrast = contrastSliders(sprites, limits, (next) => {
    curve = next;
    draw();
  });
  drawRow();
  const controls = element("div", { className: "controls" }, control.node, element("div", {}, motion.button));
  const sinogramStage = stageOf(width, height, sinogram);
  const panes = element("div", { className: "panes" },
    pane("data and prediction", element("span", { textContent: "swipe" }), stage, controls),
    pane("residual of this tilt", element("span", { textContent: `data − prediction, ± ${span}` }), stageOf(width, height, left)),
    pane("residual of one row in all tilts", element("span", { textContent: "u →  tilt ↓" }), sinogramStage, rowControl.node));
  root.prepend(panes, element("div", { className: "controls" }, ...contrast, element("span", { className: "note", textContent: unit })));
};
