// What all widgets share: making elements, unpacking sprite sheets, painting grey images through a contrast curve.
const widgets = {};

function element(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

function slider(label, { min, max, step = 1, value, text = String, change }) {
  const input = element("input", { type: "range", ariaLabel: label });
  Object.assign(input, { min, max, step });
  input.value = value;
  const output = element("output");
  const node = element("label", { className: "slider" }, element("span", { textContent: label }), input, output);
  const show = () => { output.textContent = text(Number(input.value)); };
  input.addEventListener("input", () => { show(); change(Number(input.value)); });
  show();
  return { node, input, set(next) { input.value = next; show(); } };
}

async function unpack(sprites) {
  const [count, height, width] = sprites.shape;
  const data = new Uint8Array(count * height * width);
  const canvas = element("canvas");
  const context = canvas.getContext("2d", { willReadFrequently: true });
  for (const [number, source] of sprites.sheets.entries()) {
    const image = new Image();
    image.src = source;
    await image.decode();
    canvas.width = image.width;
    canvas.height = image.height;
    context.drawImage(image, 0, 0);
    const pixels = context.getImageData(0, 0, image.width, image.height).data;
    const first = number * sprites.perSheet;
    for (let section = first; section < Math.min(count, first + sprites.perSheet); section++) {
      const tile = section - first;
      const left = (tile % sprites.columns) * width, top = Math.floor(tile / sprites.columns) * height;
      let target = section * height * width;
      for (let row = 0; row < height; row++) {
        let from = 4 * ((top + row) * image.width + left);
        for (let column = 0; column < width; column++, from += 4) data[target++] = pixels[from];
      }
    }
  }
  return data;
}

// grey value 0…255 -> shade on screen, as one opaque 32-bit pixel
function contrastCurve(black, white) {
  const curve = new Uint32Array(256);
  for (let grey = 0; grey < 256; grey++) {
    const shade = Math.round(255 * Math.min(1, Math.max(0, (grey - black) / Math.max(white - black, 1))));
    curve[grey] = (255 << 24 | shade << 16 | shade << 8 | shade) >>> 0;
  }
  return curve;
}

// shade(index) gives the 32-bit pixel of a grey value's place in the stack
function paint(canvas, width, height, start, alongRow, alongColumn, shade) {
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const image = context.createImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  let target = 0;
  for (let row = 0; row < height; row++) {
    let index = start + row * alongColumn;
    for (let column = 0; column < width; column++, index += alongRow) pixels[target++] = shade(index);
  }
  context.putImageData(image, 0, 0);
}

function contrastSliders(sprites, limits, change) {
  const unit = (grey) => sprites.low + grey * (sprites.high - sprites.low) / 255;
  const grey = (value) => Math.min(255, Math.max(0, Math.round(255 * (value - sprites.low) / (sprites.high - sprites.low))));
  let black = grey(limits[0]), white = Math.max(grey(limits[1]), grey(limits[0]) + 1);
  const step = (sprites.high - sprites.low) / 1000;
  const text = (value) => Number((Math.round(unit(value) / step) * step).toPrecision(3)).toString();
  const update = () => change(contrastCurve(black, white), black, white);
  const low = slider("black", { min: 0, max: 255, value: black, text, change: (value) => {
    black = Math.min(value, white - 1); low.set(black); update();
  } });
  const high = slider("white", { min: 0, max: 255, value: white, text, change: (value) => {
    white = Math.max(value, black + 1); high.set(white); update();
  } });
  update();
  return [low.node, high.node];
}

function scaleBar(widthInPixels, pixelSize) {
  if (!pixelSize) return "";
  const most = widthInPixels * pixelSize / 3, power = 10 ** Math.floor(Math.log10(most));
  const length = [5, 2, 1].map((digit) => digit * power).find((candidate) => candidate <= most);
  const [value, unit] = length >= 1e4 ? [length / 1e4, "µm"] : length >= 10 ? [length / 10, "nm"] : [length, "Å"];
  const bar = element("span", { className: "scale-bar", textContent: `${Number(value.toPrecision(3))} ${unit}` });
  bar.style.width = `${100 * length / (widthInPixels * pixelSize)}%`;
  return bar;
}

function pane(title, readout, stage, ...below) {
  const head = element("div", { className: "pane-title" }, element("span", { textContent: title }), readout);
  return element("div", {}, head, stage, ...below);
}

function stageOf(width, height, ...children) {
  const stage = element("div", { className: "stage" }, ...children);
  stage.style.aspectRatio = `${width} / ${height}`;
  stage.style.maxWidth = `${70 * width / height}vh`;  // a slice along a strip is seen whole
  return stage;
}

// runs step() at a pace while started and in view; the button starts and stops it
function player(stage, name, milliseconds, step, playing) {
  const button = element("button", { type: "button" });
  let visible = false, timer = 0;
  const update = () => {
    button.textContent = playing ? `Stop ${name}` : `Play ${name}`;
    clearInterval(timer);
    if (playing && visible) timer = setInterval(step, milliseconds);
  };
  button.addEventListener("click", () => { playing = !playing; update(); });
  new IntersectionObserver((entries) => { visible = entries[entries.length - 1].isIntersecting; update(); }).observe(stage);
  update();
  return { button, stop() { playing = false; update(); } };
}
