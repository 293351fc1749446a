// The cameras' small videos in step with the clock, with what was seen and what was found drawn over them.

import { effect } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { project } from "./camera";
import type { Clock } from "./clock";
import { colourOf } from "./colours";
import type { Point, Trial, View } from "./trial";

const NEAR_S = 0.04; // a video that plays on its own may be this far off before it is put right

export function Films({ trial, clock }: { trial: Trial; clock: Clock }) {
  const wide = trial.header.cameras.every((view) => view.width_px > view.height_px);
  const alone = trial.header.cameras.length === 1;
  return (
    <div class={alone ? "films alone" : wide ? "films wide" : "films"}>
      {trial.header.cameras.map((view, index) => (
        <Film key={view.name} trial={trial} clock={clock} view={view} index={index} />
      ))}
    </div>
  );
}

function Film({ trial, clock, view, index }: { trial: Trial; clock: Clock; view: View; index: number }) {
  const video = useRef<HTMLVideoElement>(null);
  const canvas = useRef<HTMLCanvasElement>(null);
  const url = view.preview && trial.url(view.preview);
  useEffect(() => {
    const film = video.current;
    const stopVideo = effect(() => {
      if (!film) return;
      const at = Math.max(clock.time_s.value + view.delay_s, 0);
      film.playbackRate = clock.speed.value;
      if (clock.playing.value) {
        if (film.paused) void film.play().catch(() => undefined);
        if (Math.abs(film.currentTime - at) > NEAR_S) film.currentTime = at;
      } else {
        film.pause();
        film.currentTime = at;
      }
    });
    const stopDrawing = effect(() => {
      void trial.arrived.value;
      draw(canvas.current!, trial, view, index, clock.time_s.value);
    });
    return () => {
      stopVideo();
      stopDrawing();
    };
  }, [trial]);
  return (
    <figure class={clock.meant.value?.camera === view.name ? "meant" : ""} style={{ aspectRatio: `${view.width_px} / ${view.height_px}`, "--shape": view.width_px / view.height_px }}>
      {url && <video ref={video} src={url} muted playsInline preload="auto" />}
      <canvas ref={canvas} width={Math.min(view.width_px, 720)} height={Math.round((view.height_px * Math.min(view.width_px, 720)) / view.width_px)} />
      <figcaption>{view.name}</figcaption>
    </figure>
  );
}

/** Draw the body as it was found, lines; what this camera saw, dots; and between the two, how far they are apart. */
function draw(canvas: HTMLCanvasElement, trial: Trial, view: View, camera: number, time_s: number) {
  const pen = canvas.getContext("2d")!;
  const scale = canvas.width / view.width_px;
  const { header } = trial;
  const frame = trial.frameAt(header.start_s + time_s);
  // What the camera saw is in its own frames.
  const seenIn = trial.frameAt(header.start_s + time_s + view.delay_s);
  const at = (name: "points" | "markers", index: number): [number, number] | null => {
    const point = trial.point(name, frame, index);
    const pixel = point && project(view, point as Point);
    return pixel && [scale * (pixel[0] + 0.5), scale * (pixel[1] + 0.5)];
  };
  pen.clearRect(0, 0, canvas.width, canvas.height);
  pen.lineCap = "round";
  for (const [start, end] of header.marker_lines) {
    const [a, b] = [at("markers", start), at("markers", end)];
    if (!a || !b) continue;
    for (const [width, colour] of [[5, "#fff"], [3, colourOf(header.markers[start]!, header.markers[end]!)]] as const) {
      pen.strokeStyle = colour;
      pen.lineWidth = width;
      pen.beginPath();
      pen.moveTo(...a);
      pen.lineTo(...b);
      pen.stroke();
    }
  }
  header.keypoints.forEach((name, index) => {
    const seen = trial.row("observed", camera, seenIn, index);
    if (!seen) return;
    const dot: [number, number] = [scale * (seen[0]! + 0.5), scale * (seen[1]! + 0.5)];
    const found = at("points", index);
    if (found) {
      pen.strokeStyle = "#f0e442";
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(...dot);
      pen.lineTo(...found);
      pen.stroke();
    }
    pen.fillStyle = colourOf(name);
    pen.beginPath();
    pen.arc(...dot, 2.5, 0, 2 * Math.PI);
    pen.fill();
  });
}
