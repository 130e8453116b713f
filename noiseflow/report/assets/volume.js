// Three orthogonal slices that follow sliders and the pointer, and the whole volume turning.
widgets.volume = async (root, options) => {
  const { sprites, original, limits, voxelSize, unit } = options;
  const data = await unpack(sprites);
  const [depth, height, width] = sprites.shape;
  const size = { z: depth, y: height, x: width };
  const full = { z: original[0], y: original[1], x: original[2] };
  const stride = { z: height * width, y: width, x: 1 };
  const position = { z: depth >> 1, y: height >> 1, x: width >> 1 };
  let curve = contrastCurve(0, 255);
  let turn = () => {};

  const views = [["x", "y", "z"], ["x", "z", "y"], ["y", "z", "x"]].map(([across, down, through]) => {
    const canvas = element("canvas", { ariaLabel: `slice ${across}${down}` });
    const lines = [element("i", { className: "cross down" }), element("i", { className: "cross across" })];
    const stage = stageOf(size[across], size[down], canvas, ...lines, scaleBar(size[across], voxelSize));
    stage.classList.add("pick");
    const control = slider(through, {
      min: 0, max: size[through] - 1, value: position[through],
      text: (index) => `${Math.round((index + 0.5) * full[through] / size[through] - 0.5)} of ${full[through]}`,
      change: (index) => { position[through] = index; draw(); },
    });
    const point = (event) => {
      const box = stage.getBoundingClientRect();
      const share = { [across]: (event.clientX - box.left) / box.width, [down]: (event.clientY - box.top) / box.height };
      for (const axis of [across, down]) {
        position[axis] = Math.min(size[axis] - 1, Math.max(0, Math.floor(share[axis] * size[axis])));
        views.find((view) => view.through === axis).control.set(position[axis]);
      }
      draw();
    };
    stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); point(event); });
    stage.addEventListener("pointermove", (event) => { if (event.buttons) point(event); });
    const readout = element("span", { textContent: `${across} →  ${down} ↓` });
    return { across, down, through, canvas, lines, control, node: pane(`slice across ${through}`, readout, stage, control.node) };
  });

  function draw() {
    for (const { across, down, through, canvas, lines } of views) {
      paint(canvas, size[across], size[down], position[through] * stride[through], stride[across], stride[down], (i) => curve[data[i]]);
      lines[0].style.left = `${100 * (position[across] + 0.5) / size[across]}%`;
      lines[1].style.top = `${100 * (position[down] + 0.5) / size[down]}%`;
    }
  }

  const turning = turningView(data, sprites.shape);
  const contrast = contrastSliders(sprites, limits, (next, black, white) => {
    curve = next;
    turn = () => turning.draw(black, white);
    draw();
    turn();
  });
  const contrastRow = element("div", { className: "controls" }, ...contrast, element("span", { className: "note", textContent: unit }));
  root.prepend(element("div", { className: "panes square" }, ...views.map((view) => view.node), turning.node), contrastRow);
};

// (1, 2, 1) / 4 along one axis, so that single noisy voxels do not sparkle
function smoothAlong(values, stride) {
  for (let start = 0; start < stride; start++) {
    let before = values[start];
    for (let i = start; i + stride < values.length; i += stride) {
      const here = values[i];
      values[i] = (before + 2 * here + values[i + stride]) >> 2;
      before = here;
    }
  }
}

// Brightest voxel along each line of sight, nearer ones brighter; drag to turn.
function turningView(data, shape) {
  const step = Math.max(1, Math.ceil(Math.max(...shape) / 96));
  const sizes = shape.map((size) => Math.ceil(size / step));
  const [depth, height, width] = sizes;
  const values = new Uint8Array(depth * height * width);
  for (let z = 0, target = 0; z < depth; z++)
    for (let y = 0; y < height; y++)
      for (let x = 0; x < width; x++) values[target++] = data[((z * shape[1] + y) * shape[2] + x) * step];
  for (const stride of [1, width, width * height]) smoothAlong(values, stride);
  const side = Math.ceil(1.25 * Math.hypot(width, depth) / 2 + 0.75 * height / 2) + 8;
  const canvas = element("canvas", { ariaLabel: "the volume from all sides" });
  const shades = new Uint8Array(side * side);
  const curve = contrastCurve(0, 255);
  let azimuth = 0.6, elevation = 0.35, limits = [0, 255];

  function draw() {
    const [black, white] = limits;
    const floor = black + 0.25 * (white - black), span = 255 / Math.max(white - black, 1);
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    const radius = Math.hypot(width, height, depth) / 2, middle = side / 2;
    shades.fill(0);
    for (let z = 0, index = 0; z < depth; z++)
      for (let y = 0; y < height; y++) {
        const dz = z - depth / 2, dy = y - height / 2;
        for (let x = 0; x < width; x++, index++) {
          if (values[index] <= floor) continue;
          const dx = x - width / 2;
          const across = ca * dx + sa * dz, away = ca * dz - sa * dx;
          const u = (middle + across) | 0, v = (middle + ce * dy + se * away) | 0;
          if (u < 0 || v < 0 || u >= side - 1 || v >= side - 1) continue;
          const near = 0.65 + 0.35 * (se * dy - ce * away) / radius;
          const shade = Math.min(255, span * (values[index] - black)) * near;
          const at = v * side + u;
          if (shade > shades[at]) shades[at] = shade;
          if (shade > shades[at + 1]) shades[at + 1] = shade;
          if (shade > shades[at + side]) shades[at + side] = shade;
          if (shade > shades[at + side + 1]) shades[at + side + 1] = shade;
        }
      }
    paint(canvas, side, side, 0, 1, side, (i) => curve[shades[i]]);
  }

  const stage = stageOf(1, 1, canvas);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const motion = player(stage, "turning", 60, () => { azimuth += 0.03; draw(); }, !still);
  stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); motion.stop(); });
  stage.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    azimuth += event.movementX * 0.01;
    elevation = Math.min(1.57, Math.max(-1.57, elevation + event.movementY * 0.01));
    draw();
  });
  const readout = element("span", { textContent: "drag to turn" });
  const controls = element("div", { className: "controls" }, motion.button);
  return { node: pane("brightest voxel along the view", readout, stage, controls), draw(black, white) { limits = [black, white]; draw(); } };
}
