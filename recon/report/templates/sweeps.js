// The phase sliders: maps the scan again with the phases that a hand adds, forward sweeps in magenta, backward sweeps in
// green. Where both show the same the picture is grey; a wrong phase moves them apart and the colours come out.
"use strict";

const bytesOf = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
const floatsOf = (text) => new Float32Array(bytesOf(text).buffer);

// A sin u and A cos u of one axis at every sample, in half fields; a phase added to u turns one into the other.
function motionOf(axis, data, samples) {
  const amplitude = floatsOf(axis.amplitude), phase = floatsOf(axis.phase);
  const sine = new Float32Array(samples), cosine = new Float32Array(samples);
  for (let i = 0; i < samples; i++) {
    const time = (Math.floor(i / data.run) * data.stride + (i % data.run)) / data.rate;
    const at = (time - axis.start) / axis.step;
    const knot = Math.min(Math.max(Math.floor(at), 0), phase.length - 2), share = at - knot;
    const between = (values) => values[knot] + share * (values[knot + 1] - values[knot]);
    const u = 2 * Math.PI * axis.frequency * time + between(phase), a = between(amplitude);
    sine[i] = a * Math.sin(u);
    cosine[i] = a * Math.cos(u);
  }
  return { sine, cosine };
}

// The scan as arrays: intensities and the motion of both axes.
function unpack(data) {
  const intensity = bytesOf(data.intensity);
  const [x, y] = data.axes.map((axis) => motionOf(axis, data, intensity.length));
  return { intensity, x, y, width: data.width, height: data.height };
}

// The pixel of a position in half fields, -1 outside: the law of the picture itself.
const pixelOf = (position, n) => Math.abs(position) <= 1 ? Math.max(Math.ceil(0.5 * n * (position + 1)) - 1, 0) : -1;

// Sums and counts of the samples in each pixel, for the sweeps [x forward, x backward, y forward, y backward].
function remap(scan, shiftX, shiftY) {
  const { intensity, x, y, width, height } = scan;
  const sweeps = [0, 1, 2, 3].map(() => ({ sum: new Float64Array(width * height), count: new Uint32Array(width * height) }));
  const cx = Math.cos(shiftX), sx = Math.sin(shiftX), cy = Math.cos(shiftY), sy = Math.sin(shiftY);
  for (let i = 0; i < intensity.length; i++) {
    const column = pixelOf(x.sine[i] * cx + x.cosine[i] * sx, width);
    const row = pixelOf(y.sine[i] * cy + y.cosine[i] * sy, height);
    if (column < 0 || row < 0 || intensity[i] === 0) continue; // 0: no intensity there
    const pixel = row * width + column;
    for (const own of [
      sweeps[x.cosine[i] * cx - x.sine[i] * sx >= 0 ? 0 : 1],
      sweeps[y.cosine[i] * cy - y.sine[i] * sy >= 0 ? 2 : 3],
    ]) {
      own.sum[pixel] += intensity[i];
      own.count[pixel] += 1;
    }
  }
  return sweeps;
}

// Mean of the samples in each pixel; an empty pixel takes that of its eight neighbours, NaN if they are empty too.
function meanOf({ sum, count }, width, height) {
  const mean = new Float32Array(sum.length);
  for (let row = 0, pixel = 0; row < height; row++) {
    for (let column = 0; column < width; column++, pixel++) {
      let total = sum[pixel], samples = count[pixel];
      if (samples === 0) {
        for (let r = Math.max(row - 1, 0); r <= Math.min(row + 1, height - 1); r++) {
          for (let c = Math.max(column - 1, 0); c <= Math.min(column + 1, width - 1); c++) {
            total += sum[r * width + c];
            samples += count[r * width + c];
          }
        }
      }
      mean[pixel] = total / samples;
    }
  }
  return mean;
}

// RGBA of two directions of one axis; transparent where one of them has nothing to show.
function coloured(forward, backward, [black, white]) {
  const rgba = new Uint8ClampedArray(4 * forward.length);
  for (let pixel = 0; pixel < forward.length; pixel++) {
    const magenta = 255 * (forward[pixel] - black) / (white - black);
    const green = 255 * (backward[pixel] - black) / (white - black);
    rgba.set([magenta, green, magenta, Number.isNaN(magenta + green) ? 0 : 255], 4 * pixel);
  }
  return rgba;
}

function start() {
  const data = JSON.parse(document.getElementById("sweeps-data").textContent);
  const scan = unpack(data);
  const views = data.axes.map((axis) => {
    const figure = document.getElementById(`sweeps-${axis.name}`);
    const amplitudes = floatsOf(axis.amplitude).filter(Number.isFinite);
    return {
      slider: figure.querySelector("input"),
      output: figure.querySelector("output"),
      reset: figure.querySelector("button"),
      context: figure.querySelector("canvas").getContext("2d"),
      // pixels of the report's picture by which a radian moves forward and backward sweeps apart, in a line's middle
      apart: axis.pixels * amplitudes.reduce((sum, each) => sum + each, 0) / amplitudes.length,
    };
  });
  const draw = () => {
    const shifts = views.map(({ slider }) => Number(slider.value) * Math.PI / 180);
    const means = remap(scan, ...shifts).map((sweep) => meanOf(sweep, scan.width, scan.height));
    views.forEach(({ slider, output, context, apart }, i) => {
      const rgba = coloured(means[2 * i], means[2 * i + 1], data.limits);
      context.putImageData(new ImageData(rgba, scan.width, scan.height), 0, 0);
      const degrees = Number(slider.value);
      const text = `${degrees < 0 ? "−" : "+"}${Math.abs(degrees).toFixed(2)}°, sweeps ${(apart * Math.abs(shifts[i])).toFixed(1)} px apart`;
      output.textContent = degrees === 0 ? "0.00°, the estimate" : text;
      slider.setAttribute("aria-valuetext", output.textContent);
    });
  };
  for (const { slider, reset } of views) {
    slider.addEventListener("input", draw);
    reset.addEventListener("click", () => { slider.value = 0; draw(); });
  }
  draw();
}

if (typeof document !== "undefined") start();
