// The look of the player's elements.

export const STYLE = `
:host { display: block; }
.player { --radius: 8px; box-sizing: border-box; display: flex; flex-direction: column; font: 14px/1.4 system-ui, -apple-system, "Segoe UI",
  Roboto, "Helvetica Neue", Arial, sans-serif; color: var(--ink); background: var(--back); border: 1px solid var(--line);
  border-radius: var(--radius); overflow: hidden; position: relative; }
.player.fill { height: 100vh; height: var(--player-height, 100dvh); border: 0; border-radius: 0; }
.player *, .player *::before { box-sizing: border-box; }
header { display: flex; align-items: center; gap: 8px; padding: 10px 10px 10px 16px; border-bottom: 1px solid var(--line); }
h1 { font-size: 15px; font-weight: 600; margin: 0; flex: 1; min-width: 0; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.stage { display: grid; grid-auto-columns: minmax(0, 1fr); grid-auto-flow: column; min-height: 0; }
.fill .stage { flex: 1; }
.panel { position: relative; min-width: 0; min-height: 0; margin: 0; }
.panel + .panel { border-left: 1px solid var(--line); }
.narrow .stage { grid-auto-flow: row; grid-auto-rows: minmax(0, 1fr); }
.narrow .panel + .panel { border-left: 0; border-top: 1px solid var(--line); }
.panel canvas { display: block; width: 100%; height: 100%; touch-action: none; cursor: grab; outline-offset: -2px; }
.panel canvas:active { cursor: grabbing; }
figcaption { position: absolute; left: 16px; top: 10px; right: 16px; pointer-events: none; font-size: 13px; color: var(--soft);
  overflow-wrap: anywhere; }
figcaption b { color: var(--ink); font-weight: 600; }
.strip { position: relative; height: 104px; background: var(--panel); border-top: 1px solid var(--line); flex: none; }
.strip canvas { display: block; width: 100%; height: 100%; touch-action: none; cursor: ew-resize; }
.strip select { position: absolute; left: 8px; top: 3px; max-width: 46%; }
.controls { display: flex; flex-wrap: wrap; align-items: center; gap: 6px 8px; padding: 8px 10px; background: var(--panel);
  border-top: 1px solid var(--line); flex: none; }
.group { display: flex; flex-wrap: wrap; gap: 6px; align-items: center; }
.time { font-variant-numeric: tabular-nums; white-space: nowrap; min-width: 11ch; color: var(--soft); }
.time b { color: var(--ink); font-weight: 600; }
button, select { font: inherit; font-size: 13px; color: var(--ink); background: transparent; border: 1px solid transparent; border-radius: 6px;
  height: 32px; padding: 0 8px; margin: 0; cursor: pointer; }
button:hover, select:hover { background: color-mix(in srgb, var(--ink) 8%, transparent); }
button[aria-pressed="true"] { color: color-mix(in srgb, var(--accent) 75%, var(--ink)); background: color-mix(in srgb, var(--accent) 14%, transparent); }
button:disabled { opacity: 0.5; cursor: default; }
option { color: #111; background: #fff; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 1px; }
button svg { display: block; width: 18px; height: 18px; fill: currentColor; }
button.icon { width: 34px; padding: 0; display: grid; place-items: center; flex: none; }
button.primary { background: var(--accent); color: var(--on-accent); width: 40px; height: 40px; border-radius: 50%; }
button.primary:hover { background: color-mix(in srgb, var(--accent) 86%, var(--ink)); }
input[type="range"] { accent-color: var(--accent); height: 32px; margin: 0; cursor: pointer; }
.line { flex: 1 1 140px; min-width: 100px; position: relative; display: flex; }
.scrub { flex: 1; min-width: 0; }
.ticks { position: absolute; inset: -3px 0 auto; width: 100%; height: 12px; pointer-events: none; }
.happened { color: var(--force); font-weight: 600; }
.amplitude { display: flex; align-items: center; gap: 6px; font-size: 13px; color: var(--soft); }
.amplitude input { width: 96px; }
.help { position: absolute; inset: 0; display: grid; place-items: center; background: color-mix(in srgb, var(--back) 72%, transparent); z-index: 2; }
.help[hidden] { display: none; }
.help dl { display: grid; grid-template-columns: auto auto; gap: 5px 18px; margin: 0; padding: 18px 22px; background: var(--panel); max-height: 96%;
  overflow: auto; border: 1px solid var(--line); border-radius: var(--radius); box-shadow: 0 8px 30px rgb(0 0 0 / 22%); font-size: 13px; }
.help dt { font-weight: 600; text-align: right; white-space: nowrap; }
.help dd { margin: 0; color: var(--soft); }
@media (pointer: coarse) { button, select { height: 38px; } button.icon { width: 40px; } button.primary { width: 44px; height: 44px; } }
`;
