"""The page's own modules, run in the browser: parsers, forms, columns, charts."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

if TYPE_CHECKING:
    from conftest import Browser


@pytest.fixture
def page(browser: Browser) -> Browser:
    browser.open("/")
    browser.find("#token")
    return browser


def test_event_stream_split_anywhere_gives_the_same_events(page: Browser) -> None:
    text = (
        ': hello\r\n\r\nid: 1-2-3\r\nevent: log\r\ndata: {"a":\r\ndata: 1}\r\n\r\nevent: end\ndata:x\n\ndata: cut off'
    )
    found = page.module(
        """
        const { EventParser } = await import("/ui/js/stream.js");
        const seen = new Set();
        for (let i = 0; i <= args[0].length; i++) for (const j of [i, i + 1, i + 7]) {
          const parser = new EventParser();
          const parts = [args[0].slice(0, i), args[0].slice(i, j), args[0].slice(j)];
          seen.add(JSON.stringify(parts.flatMap((p) => parser.feed(p))));
        }
        return [...seen].map(JSON.parse);
        """,
        text,
    )
    assert found == [
        [{"type": "log", "data": '{"a":\n1}', "id": "1-2-3"}, {"type": "end", "data": "x"}],
    ]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("10M", 10_000_000),
        ("250k", 250_000),
        ("2.5e5", 250_000),
        ("1,500,000", 1_500_000),
        ("10_000", 10_000),
        (" 0.3 ", 0.3),
        ("-1", -1),
        (".5", 0.5),
        ("5e-4", 0.0005),
        ("", None),
        ("ten", None),
        ("1e", None),
        ("1 2 x", None),
        ("--1", None),
    ],
)
def test_numbers_are_read_as_people_type_them(page: Browser, text: str, value: float | None) -> None:
    got = page.module(
        "const v = (await import('/ui/js/schema.js')).number(args[0]); return Number.isNaN(v) ? null : v;", text
    )
    assert got == value


def test_a_message_is_seen_above_an_open_dialog(page: Browser) -> None:
    page.module(
        """
        const { toast } = await import("/ui/js/dom.js");
        toast("earlier", "error");
        const dialog = document.createElement("dialog");
        dialog.style = "inset: 0; width: 100vw; height: 100vh; max-width: none; max-height: none; background: #010203";
        document.body.append(dialog);
        dialog.showModal();
        toast("no answer", "error");
        """
    )
    for message in page.all(".toast"):
        with Image.open(io.BytesIO(message.screenshot_as_png)) as picture:
            assert picture.getcolors(1) is None, "the dialog, of one color, hides the message"


def test_seeds_are_read_as_list_and_range(page: Browser) -> None:
    got = page.module(
        """
        const { seeds } = await import("/ui/js/schema.js");
        const read = (t) => { try { return seeds(t); } catch (e) { return e.message; } };
        return args[0].map(read);
        """,
        ["0", "0, 1 2", "3-5, 9", "1, 1", "5-3", "", "-1", "0-999"],
    )
    assert got[:3] == [[0], [0, 1, 2], [3, 4, 5, 9]]
    assert [type(answer) for answer in got[3:]] == [str] * 5


def test_a_setting_that_a_plugin_declares_overrides_no_preset(page: Browser) -> None:
    """Presets do not change its default: only inherited settings are compared with the preset's values."""
    got = page.module(
        """
        const { field } = await import("/ui/js/schema.js");
        const { overrides } = await import("/ui/js/views/spec-list.js");
        const entries = Object.entries(args[0]).map(([name, schema]) => [`task.${name}`, field(name, schema, {})]);
        const fields = new Map(entries);
        const preset = { name: "fast", task: { drift_penalty: 1, reward_scale: 100 }, algorithm: {} };
        const spec = { algorithm: { preset: "fast" }, task: { drift_penalty: 0.05, reward_scale: 10 } };
        return [...overrides(spec, [preset], "nao", fields)];
        """,
        {"drift_penalty": {"type": "number", "default": 0.05, "own": True}, "reward_scale": {"type": "number"}},
    )
    assert got == ["task.reward_scale"]


def test_numpy_archives_read_as_numpy_wrote_them(page: Browser) -> None:
    rng = np.random.default_rng(3)
    arrays = {
        "x": rng.normal(size=(7, 11)).astype(np.float32),
        "counts": np.arange(-3, 4, dtype=np.int64),
        "flags": np.array([True, False, True]),
        "cycle_s": np.array(0.02),
        "empty": np.zeros((0, 5), dtype=np.float64),
        "nan": np.array([np.nan, 1.0]),
    }
    for save in (np.savez, np.savez_compressed):
        buffer = io.BytesIO()
        save(buffer, **arrays)
        got = page.module(
            """
            const { readNpz } = await import("/ui/js/npz.js");
            const bytes = Uint8Array.from(atob(args[0]), (c) => c.charCodeAt(0));
            const arrays = await readNpz(bytes.buffer);
            return Object.fromEntries([...arrays].map(([k, v]) =>
              [k, { shape: v.shape, data: [...v.data].map((x) => (Number.isNaN(x) ? null : x)) }]));
            """,
            base64.b64encode(buffer.getvalue()).decode(),
        )
        assert set(got) == set(arrays)
        for name, array in arrays.items():
            assert got[name]["shape"] == list(array.shape), name
            expected = [None if value != value else float(value) for value in array.ravel()]
            assert [None if v is None else float(v) for v in got[name]["data"]] == expected, name


@pytest.mark.parametrize("damage", [b"", b"PK\x05\x06", b"not an archive at all, only text"])
def test_damaged_archives_are_refused(page: Browser, damage: bytes) -> None:
    refused = page.module(
        """
        const { readNpz } = await import("/ui/js/npz.js");
        const bytes = Uint8Array.from(atob(args[0]), (c) => c.charCodeAt(0));
        try { await readNpz(bytes.buffer); return false; } catch (e) { return e instanceof Error; }
        """,
        base64.b64encode(damage).decode(),
    )
    assert refused is True


def test_a_row_that_goes_back_replaces_what_lies_behind_it(page: Browser) -> None:
    got = page.module(
        """
        const { Columns } = await import("/ui/js/columns.js");
        const m = new Columns();
        m.load({ step: [10, 20, 30], reward: [1, 2, 3], attempt: [1, 1, 1] });
        m.push({ step: 40, reward: 4, attempt: 1 });
        m.push({ step: 20, reward: 9, speed_mps: 0.5, attempt: 2 });
        m.push({ step: 30, attempt: 2 });
        return [m.step, m.get("reward"), m.get("speed_mps"), m.get("unknown"), m.last("reward"), m.csv()];
        """
    )
    assert got == [
        [10, 20, 30],
        [1, 9, None],
        [None, 0.5, None],
        [None, None, None],
        9,
        "step,reward,speed_mps\n10,1,\n20,9,0.5\n30,,\n",
    ]


def test_mean_and_band_of_curves_with_different_ends(page: Browser) -> None:
    mean, low, high = page.module(
        """
        const { band } = await import("/ui/js/views/compare.js");
        const b = band([[[0, 10], [0, 10]], [[0, 10], [2, 12]], [[0, 5], [1, 6]]], [0, 5, 10, 11]);
        return [b.mean, b.low, b.high];
        """
    )
    assert mean == [1, 6, 11, None]
    assert low[0] == pytest.approx(0)
    assert high[2] == pytest.approx(11 + 2**0.5)


def test_a_band_of_shares_stays_between_none_and_all(page: Browser) -> None:
    shares, speeds, signed = page.module(
        """
        const { band } = await import("/ui/js/views/compare.js");
        const of = (values, max) => {
          const b = band(values.map((v) => [[0], [v]]), [0], max);
          return [b.low[0], b.high[0]];
        };
        return [of([0, 0, 1, 1], 1), of([0, 4]), of([-1, 1])];
        """
    )
    assert shares == [0, 1]
    assert speeds == pytest.approx([0, 2 + 8**0.5])
    assert signed == pytest.approx([-(2**0.5), 2**0.5])


def test_thinned_columns_keep_extremes_ends_and_the_zoomed_part(page: Browser) -> None:
    count, width, spike, low, high = page.module(
        """
        const { thin } = await import("/ui/js/charts.js");
        const n = 100_000, x = Array.from({ length: n }, (_, i) => i);
        const y = x.map((i) => Math.sin(i / 500)), gaps = x.map((i) => (i % 3 ? null : i));
        y[77_777] = 9;
        const [xs, ys, gs] = thin([x, y, gaps], 0, n - 1, 500);
        if (xs[0] !== 0 || xs.at(-1) !== n - 1) throw new Error("the ends are gone");
        if (xs.some((v, i) => i && v <= xs[i - 1])) throw new Error("x does not grow");
        if (xs.some((v, i) => ys[i] !== y[v] || gs[i] !== gaps[v])) throw new Error("values moved");
        const [zs] = thin([x, y], 50_000, 50_400, 500);
        const short = [[1, 2, 3], [1, 2, 3]];
        if (thin(short, 1, 3, 500) !== short) throw new Error("short columns were touched");
        const inside = zs.filter((v) => v >= 50_000 && v <= 50_400);
        return [xs.length, inside.length, Math.max(...ys), zs[0], zs.at(-1)];
        """
    )
    assert count <= 5 * 500 + 2
    assert width == 401, "the zoomed part is not complete"
    assert spike == 9
    assert (low, high) == (0, 99_999)


@pytest.mark.parametrize(
    ("unit", "values", "low", "high"),
    [
        ("%", [0, 0], 0, 1),
        ("%", [1, 1], 0, 1),
        ("%", [0.1, 1.5], 0, 1.5),
        ("m", [0, 0], 0, 1),
        ("m", [5, 5], 4.5, 5.5),
        ("m", [0.1, 100], 0, 106.993),
        ("m", [-3, -3], -3.3, -2.7),
        ("m", [-100, 0], -107, 0),
        ("m", [-1, 1], -1.14, 1.14),
    ],
)
def test_axes_cross_zero_only_where_values_do(
    page: Browser, unit: str, values: list[float], low: float, high: float
) -> None:
    shown, study = page.module(
        """
        const { Chart } = await import("/ui/js/charts.js");
        const { chartOptions } = await import("/ui/js/curves.js");
        const { curves } = await import("/ui/js/study-figures.js");
        const metric = { name: "y", title: "Y", unit: args[0], digits: 1 };
        const options = chartOptions({ key: "y", title: "Y", metrics: [metric], refs: [] });
        const chart = new Chart({ ...options, series: [{ label: "y", token: "--s1" }] });
        document.getElementById("main").replaceChildren(chart.element);
        chart.setData([[0, 1], args[1]]);
        while (!chart.u) await new Promise((r) => requestAnimationFrame(r));
        await new Promise((r) => requestAnimationFrame(r));
        const { min, max } = chart.u.scales.y;
        chart.destroy();
        const line = { label: "", token: "--s1", x: [0, 1], y: args[1] };
        const ticks = [...curves(400, [line], metric).querySelectorAll("text[text-anchor=end]")];
        return [[min, max], ticks.map((e) => Number(e.textContent.replace("\u2212", "-")))];
        """,
        unit,
        values,
    )
    assert shown == pytest.approx([low, high])
    scale = 100 if unit == "%" else 1
    assert low * scale <= min(study), "ticks of a study's curves"
    assert max(study) <= high * scale


def test_a_single_value_is_drawn_and_ticks_differ(page: Browser) -> None:
    drawn, hidden, texts, circles = page.module(
        """
        const { Chart } = await import("/ui/js/charts.js");
        const { compact, distinct } = await import("/ui/js/format.js");
        const { curves } = await import("/ui/js/study-figures.js");
        const paint = async (series) => {
          const chart = new Chart({ title: "Y", series });
          document.getElementById("main").replaceChildren(chart.element);
          const columns = series.map((_, i) => [null, 1 + i, null]);
          chart.setData([[0, 1, 2], ...columns]);
          while (!chart.u) await new Promise((r) => requestAnimationFrame(r));
          await new Promise((r) => requestAnimationFrame(r));
          const { left, top, width, height } = chart.u.bbox;
          const { data } = chart.u.ctx.getImageData(left, top, width, height);
          chart.destroy();
          return data.reduce((sum, v, i) => sum + (i % 4 === 0 && v < 100 && data[i + 3] > 200), 0);
        };
        const line = { label: "y", token: "--s1" };
        const metric = { name: "y", title: "Y", unit: "m", digits: 1 };
        const figure = curves(400, [{ ...line, x: [256], y: [1] }], metric);
        return [
          await paint([line]),
          await paint([{ ...line, hidden: true }]),
          [distinct([2.7181, 2.7182], compact), distinct([10_150, 10_160], compact), distinct([1, 2], compact)],
          figure.querySelectorAll("circle").length,
        ];
        """
    )
    assert drawn > 10
    assert hidden == 0
    assert texts == [["2.7181", "2.7182"], ["10.15k", "10.16k"], ["1", "2"]]
    assert circles == 1


def test_rewards_on_both_engines_are_one_chart(page: Browser) -> None:
    titles = page.module(
        """
        const { Descriptions } = await import("/ui/js/descriptions.js");
        const titles = (...columns) => new Descriptions().charts({}, columns).map((c) => c.title);
        return [titles(), titles("left_to_mujoco", "evaluation_engine_reward", "training_engine_reward", "own")];
        """
    )
    assert "Reward by engine" not in titles[0]
    assert sorted(set(titles[1]) - set(titles[0])) == ["Own", "Reward by engine", "Substeps left to MuJoCo"]


def test_marks_of_values_near_zero_differ(page: Browser) -> None:
    marks, lines, share = page.module(
        """
        const { ticks } = await import("/ui/js/figures.js");
        const { metricAxis } = await import("/ui/js/plots.js");
        const { chartOptions } = await import("/ui/js/curves.js");
        const { distinct } = await import("/ui/js/format.js");
        const metric = { name: "loss", title: "Loss", unit: "", digits: 4 };
        const share = { key: "rate", title: "Rate", metrics: [{ ...metric, unit: "%" }], refs: [] };
        return [
          metricAxis(metric, [0, 4e-9]).marks.map(([, text]) => text.replace("\u2212", "-")),
          ticks(0, 5e-12, 5).length,
          distinct([0, 1e-8, 2e-8], chartOptions(share).axisFormat).map((text) => text.replace("\u2212", "-")),
        ];
        """
    )
    assert marks == ["0", "1e-9", "2e-9", "3e-9", "4e-9"]
    assert lines == 6
    assert share == ["0 %", "1e-6 %", "2e-6 %"]


def test_dragging_zooms_all_linked_charts_and_a_double_click_shows_all(page: Browser) -> None:
    whole, zoomed, appended, again = page.module(
        """
        const { Chart } = await import("/ui/js/charts.js");
        const options = { sync: "pair", series: [{ label: "y", token: "--s1" }] };
        const charts = ["One", "Two"].map((title) => new Chart({ ...options, title }));
        const main = document.getElementById("main");
        main.replaceChildren(...charts.map((c) => c.element));
        const x = Array.from({ length: 1001 }, (_, i) => i), y = x.map((i) => Math.sin(i / 50));
        const show = () => { for (const c of charts) c.setData([[...x], [...y]]); };
        const spans = async () => {
          for (let k = 0; k < 6; k++) await new Promise((r) => requestAnimationFrame(r));
          return charts.map((c) => [c.u.scales.x.min, c.u.scales.x.max]);
        };
        show();
        const whole = await spans();
        const over = charts[0].u.over, box = over.getBoundingClientRect();
        const mouse = (type, share, target = over) => target.dispatchEvent(new MouseEvent(type, {
          bubbles: true, button: 0, movementX: 9, clientX: box.left + share * box.width, clientY: box.top + 20,
        }));
        mouse("mousemove", 0.25);
        mouse("mousedown", 0.25);
        mouse("mousemove", 0.75);
        await new Promise((r) => requestAnimationFrame(r));
        mouse("mouseup", 0.75, document);
        const zoomed = await spans();
        if (charts.some((c) => c.u.select.width)) throw new Error("the selection stayed");
        x.push(1001);
        y.push(3);
        show();
        const appended = await spans();
        mouse("dblclick", 0.5);
        const again = await spans();
        for (const c of charts) c.destroy();
        return [whole, zoomed, appended, again];
        """
    )
    assert whole == [[0, 1000]] * 2
    assert zoomed[0] == zoomed[1]
    assert zoomed[0] == pytest.approx([250, 750], abs=5)
    assert appended == zoomed, "new rows moved the zoom"
    assert again == [[0, 1001]] * 2


def test_the_curves_stay_smooth_at_100_000_points(page: Browser) -> None:
    """All charts of a job page together, each metric that they show, while rows come in and while zooming."""
    page.theme("light")
    following, zooming, reset, drawn = page.module(
        """
        const { CurvesTab } = await import("/ui/js/views/job-curves.js");
        const { Columns } = await import("/ui/js/columns.js");
        const { Descriptions } = await import("/ui/js/descriptions.js");
        const get = async (path) => (await fetch(path)).json();
        const known = new Descriptions(await get("/tasks"), await get("/algorithms"), await get("/robots"));
        const spec = { task: { name: "sprint1" }, algorithm: { name: "ppo" } }, curves = known.charts(spec);
        const native = window.requestAnimationFrame.bind(window), spent = [];
        // What the page does in a frame; canvases are drawn in it, too.
        window.requestAnimationFrame = (work) => native((now) => {
          const before = performance.now();
          work(now);
          spent.push(performance.now() - before);
        });
        const names = ["time_s", ...curves.flatMap((c) => c.metrics.map((m) => m.name))];
        const value = (name, i) => (name === "time_s" ? i / 3 : Math.sin(i / 3000 + name.length) + Math.random() / 5);
        const values = (i) => Object.fromEntries(names.map((name) => [name, value(name, i)]));
        const row = (i) => ({ step: 8192 * (i + 1), ...values(i) });
        const metrics = new Columns();
        for (let i = 0; i < 100_000; i++) metrics.push(row(i));
        const store = Object.assign(new EventTarget(), {
          id: "x", metrics, job: { state: "running", spec, name: "x" }, known,
          on(topic, listener) { this.addEventListener(topic, listener); },
        });
        const root = document.getElementById("main");
        root.replaceChildren();
        const tab = new CurvesTab(root, store);
        const frame = () => new Promise((r) => native(() => native(r)));
        const settled = async () => { let n; do { n = spent.length; await frame(); } while (spent.length !== n); };
        await settled();
        const charts = tab.charts.map((c) => c.chart);
        if (charts.filter((c) => c.u).length !== curves.length) throw new Error("not all charts were drawn");
        const longest = async (act) => {
          spent.length = 0;
          const before = performance.now();
          act();
          await null; // charts draw behind the task that zooms
          const own = performance.now() - before;
          await settled();
          if (!spent.length) throw new Error("nothing was drawn");
          return Math.max(own, ...spent);
        };
        const rounds = async (act) => {
          const times = [];
          for (let k = 0; k < 8; k++) times.push(await longest(() => act(k)));
          return Math.min(...times); // what the machine's other work adds is not ours
        };
        const following = await rounds(() => {
          metrics.push(row(metrics.length));
          store.dispatchEvent(new Event("metrics"));
        });
        if (charts[0].data[0].at(-1) !== metrics.step.at(-1)) throw new Error("the newest row is not shown");
        const span = metrics.step.at(-1);
        const zooming = await rounds((k) => charts[0].zoom([span * (0.3 + k / 100), span * (0.31 + k / 100)]));
        const { min, max } = charts[0].u.scales.x;
        const inside = charts[0].shown[0].filter((x) => x >= min && x <= max).length;
        const reset = await rounds((k) => charts[0].zoom(k % 2 ? [span / 2, span] : null));
        tab.destroy();
        window.requestAnimationFrame = native;
        return [following, zooming, reset, inside];
        """
    )
    print(  # noqa: T201
        f"longest frame at 100,000 points in each chart: {following:.1f} ms following, {zooming:.1f} ms zooming, "
        f"{reset:.1f} ms zooming out; {drawn} points in the zoomed part"
    )
    # 50 ms is where people begin to feel a delay; this is a software renderer.
    assert max(following, zooming, reset) < 50
    assert drawn >= 900, "zooming in does not show more points"


def test_text_in_csv_is_no_formula(page: Browser) -> None:
    rows = [["=1+1", "@a", "+b", "-c", "-1", "a=b"], [-1, 2.5, None, 'x,"y"', "", 0]]
    text = page.module("return (await import('/ui/js/format.js')).csv(args[0])", rows)
    assert text == '\'=1+1,\'@a,\'+b,\'-c,-1,a=b\n-1,2.5,,"x,""y""",,0\n'


def test_metrics_are_written_as_their_descriptions_say(page: Browser) -> None:
    metrics = [
        {"name": "a", "unit": "m/s", "digits": 2},
        {"name": "b", "unit": "%", "digits": 1},
        {"name": "c", "unit": "°", "digits": 1},
        {"name": "d", "unit": "", "digits": 0},
        {"name": "e", "unit": "", "digits": None},
        {"name": "f", "unit": "", "digits": 6},
    ]
    found = page.module(
        """
        const { withUnit } = await import("/ui/js/format.js");
        return args[0].map((m, i) => withUnit(m, args[1][i]));
        """,
        metrics,
        [4.034, 0.0042, -3.25, 12345.4, 0.00125, 5e-4],
    )
    assert found == ["4.03 m/s", "0.4 %", "\N{MINUS SIGN}3.3°", "12,345", "0.00125", "0.000500"]


@pytest.mark.parametrize(
    ("robot", "length", "goal"), [("nao-0", 30.0, [2.1, 0.8]), ("k1", 55.0, [3.66, 1.83]), ("gone", None, None)]
)
def test_replays_and_paths_are_on_the_field_of_the_league(
    page: Browser, robot: str, length: float | None, goal: list[float] | None
) -> None:
    """A robot that the service does not have, of a package that is gone, is on bare ground."""
    found = page.module(
        """
        const [{ Recording, Stage }, { Descriptions }, { field }] = await Promise.all(
          ["replay3d", "descriptions", "figures"].map((name) => import(`/ui/js/${name}.js`)));
        const ground = new Descriptions([], [], await (await fetch("/robots")).json()).field(args[0]);
        const frames = 3;
        const recording = new Recording({
          format: 2, frames, dt_s: 0.02, end: "", failed: false, foot_force_n: Array(frames).fill([0, 0]),
          bodies: [{ name: "torso", shape: "box", size_m: [0.1, 0.2, 0.3], side: "centre" },
            { name: "ball", shape: "sphere", size_m: [0.11, 0, 0], side: "centre" }],
          position_m: [0, 1, 2].map((t) => [0, 0, 0.5, 1 + t, 0, 0.11]),
          rotation_wxyz: Array(frames).fill([1, 0, 0, 0, 1, 0, 0, 0]) }, 0);
        const host = document.getElementById("main");
        host.replaceChildren();
        const stage = new Stage(host, recording, ground);
        const ends = stage.scene.children.filter((m) => m.material === stage.chalk)
          .map((m) => m.position.x + m.geometry.parameters.width / 2 || 0);
        const goals = stage.goals.map((g) => g.position.x);
        stage.show(1.5);
        const ball = stage.parts[1];
        const shown = { x: ball.position.x, radius: ball.geometry.parameters.radius, leather: !!ball.material.map };
        stage.destroy();
        const episode = { x: [0, 1], y: [0, 0], samples: 2, failed: false, distance: 1, seconds: 1, speed: 1 };
        const paths = { ground, lines: [], count: 1, episode: () => episode, all: () => [episode] };
        const picture = field(900, paths, { selected: 0, half: 3, onSelect: () => {} });
        const last = [...picture.querySelectorAll("text")].at(-1).textContent;
        return { ends: Math.max(0, ...ends), goals, last, goal: ground.goal, shown };
        """,
        robot,
    )
    assert found["shown"] == {"x": 2.5, "radius": 0.11, "leather": True}
    if length is None or goal is None:
        assert (found["ends"], found["goals"], found["goal"]) == (0, [], None)
        return
    assert found["ends"] == pytest.approx(length / 2, abs=0.06)
    assert found["goals"] == [-length / 2, length / 2]
    assert [found["goal"]["width_m"], found["goal"]["height_m"]] == goal
    assert found["last"] == {30.0: "15 m", 55.0: "20 m"}[length]


def test_a_game_is_drawn_from_a_log_with_all_its_robots(page: Browser) -> None:
    """Two T1: one that has turned to the left and pitches its head, one that enters in the last frame."""
    found = page.module(
        """
        const [{ GameStage, figureOf }, { GameLog }, { Descriptions }, T] = await Promise.all([
          ...["game3d", "game-log", "descriptions"].map((name) => import(`/ui/js/${name}.js`)),
          import("/ui/vendor/three-0.187.0/three.min.js")]);
        const ground = new Descriptions([], [], await (await fetch("/robots")).json()).field("t1");
        const joints = new Int16Array(2 * 2 * 23);
        joints[1] = joints[46 + 1] = Math.round(Math.PI / 2 / 2e-4);
        const turned = [7071, 0, 0, 7071];
        const arrays = { half: new Uint8Array(2), clock_s: new Float32Array([0, 0.04]), score: new Uint8Array(4),
          ball: new Int16Array([0, 0, 110, 1000, 0, 110]),
          torso: new Int16Array([1000, 2000, 670, 0, 0, 0, 1100, 2000, 670, 0, 0, 670]),
          quaternion: new Int16Array([...turned, 10000, 0, 0, 0, ...turned, 10000, 0, 0, 0]),
          joints, present: new Uint8Array([1, 0, 1, 1]) };
        const log = new GameLog({ teams: ["a", "b"], robots: [[0, 1], [1, 4]], notes: {} }, arrays);
        const host = document.getElementById("main");
        host.replaceChildren();
        const stage = new GameStage(host, log, await figureOf(log), ground);
        const centre = (part, robot) => {
          const matrix = new T.Matrix4();
          stage.figures.parts.find((each) => each.shape.part === part).mesh.getMatrixAt(robot, matrix);
          return [...matrix.elements.slice(12, 15), matrix.determinant()];
        };
        stage.show(0.5);
        const half = { torso: centre("torso", 0), head: centre("head", 0), absent: centre("torso", 1),
          ball: stage.ball.position.toArray(), plates: stage.plates.map((each) => each.visible) };
        stage.show(1);
        const last = { plates: stage.plates.map((each) => each.visible), torso: centre("torso", 1) };
        stage.aim(0);
        const behind = stage.camera.position.clone().sub(stage.controls.target).toArray();
        const longer = log.joined(log, 1, 2);
        stage.destroy();
        return { half, last, behind, shade: stage.figures.parts.length, frames: longer.frames,
          clock: [...longer.clock_s], width: longer.width };
        """
    )
    half, last = found["half"], found["last"]
    # its front, x, points to the field's y
    assert half["torso"] == pytest.approx([1.05, 2.06, 0.79, 1.0], abs=2e-3)
    # the head looks down, so that what was above the joint is before it, and what was before it below
    assert half["head"] == pytest.approx([1.05, 2.0 + 0.0625 + 0.11, 0.67 + 0.3049 - 0.01, 1.0], abs=2e-3)
    assert half["absent"][3] == 0.0
    assert half["ball"] == pytest.approx([0.5, 0.0, 0.11])
    assert half["plates"] == [True, False]
    assert last["plates"] == [True, True]
    assert last["torso"] == pytest.approx([0.06, 0.0, 0.79, 1.0], abs=2e-3)
    assert found["behind"][1] < -2.0, "the camera stands behind the robot"
    assert abs(found["behind"][0]) < 1e-3
    assert (found["frames"], found["clock"], found["width"]) == (2, pytest.approx([0.04, 0.04]), 23)


@pytest.mark.parametrize("size", [1.0, 2.08])
def test_cameras_show_all_of_a_robot_and_its_head_has_a_neck(page: Browser, size: float) -> None:
    """A robot that lies in its first frame, with a head of any name."""
    found = page.module(
        """
        const { Recording, Stage } = await import("/ui/js/replay3d.js");
        const { Descriptions } = await import("/ui/js/descriptions.js");
        const ground = new Descriptions([], [], await (await fetch("/robots")).json()).field("t1");
        const size = args[0];
        const shapes = [["torso", "box", 0.37], ["h1", "sphere", 0.25], ["h2", "sphere", 0.52], ["foot", "box", 0.02]];
        const recording = new Recording({
          format: 2, frames: 2, dt_s: 0.02, end: "", failed: false, foot_force_n: [[0, 0], [0, 0]],
          bodies: shapes.map(([name, shape]) => ({ name, shape, size_m: [0.1, 0.1, 0.1],
            side: name === "foot" ? "left" : "centre" })),
          position_m: [shapes.flatMap(() => [0, 0, 0.1]), shapes.flatMap((s) => [0, 0, s[2] * size])],
          rotation_wxyz: Array(2).fill(shapes.flatMap(() => [1, 0, 0, 0])) }, 0);
        const host = document.getElementById("main");
        host.replaceChildren();
        const stage = new Stage(host, recording, ground);
        stage.show(1);
        const from = stage.camera.position.distanceTo(stage.controls.target);
        const neck = [stage.neck.position.z, stage.neck.scale.y];
        stage.destroy();
        return { head: recording.head, size: recording.size, from, neck };
        """,
        size,
    )
    assert found["head"] == 2
    assert found["size"] == pytest.approx(size)
    assert found["from"] == pytest.approx(1.52 * size, rel=0.02)
    low, high = 0.37 * size + 0.04, 0.52 * size
    assert found["neck"] == pytest.approx([(low + high) / 2, high - low])


def test_what_nobody_describes_is_shown_by_its_name(page: Browser) -> None:
    found = page.module(
        """
        const { Descriptions } = await import("/ui/js/descriptions.js");
        const metric = (name, title) => ({ name, title, unit: "", digits: 2, better: null });
        const task = { name: "jump", metrics: [metric("height_m", "Height")], listed: ["height_m", "gone"],
          charts: [{ title: "Jumps", metrics: ["height_m"] }],
          references: [{ metric: "height_m", value: 2, title: "record" }] };
        const known = new Descriptions([task], []);
        const charts = (spec, columns) => known.charts(spec, columns).filter((c) => c.group === "task")
          .map((c) => [c.title, c.metrics.map((m) => m.title), c.refs]);
        return [charts({ task: { name: "jump" } }, ["height_m", "my_metric", "step", "eta_s"]),
          charts({ task: "gone" }, ["height_m"]), known.listed({ task: { name: "jump" } }).map((m) => m.title)];
        """
    )
    assert found == [
        [["Jumps", ["Height"], [{"y": 2, "label": "record", "metric": "height_m"}]], ["My metric", ["My metric"], []]],
        [["Height m", ["Height m"], []]],
        ["Height"],
    ]


def test_lines_and_results_of_another_robot_are_not_shown(page: Browser) -> None:
    """Some numbers are of one family of robots; documents of earlier versions contain them for all."""
    found = page.module(
        """
        const { Descriptions } = await import("/ui/js/descriptions.js");
        const metric = (name, families = null) => ({ name, title: name, unit: "", digits: 2, better: null, families });
        const task = { name: "run", metrics: [metric("speed")], listed: [],
          results: [metric("low", ["nao"]), metric("top")], charts: [{ title: "Speed", metrics: ["speed"] }],
          references: [{ metric: "speed", value: 3.91, title: "the paper", families: ["nao"] },
            { metric: "speed", value: 5, title: "all", families: null }] };
        const robots = [{ name: "nao-0", family: "nao" }, { name: "t1", family: "booster" }];
        const known = new Descriptions([task], [], robots);
        const results = [{ name: "low" }, { name: "top" }];
        const of = (robot) => [
          known.charts({ task: { name: "run" }, robot: { name: robot } })[0].refs.map((r) => r.label),
          known.results({ task: { name: "run" }, robot, results }).map((r) => r.name),
        ];
        return ["nao-0", "t1", "unknown"].map(of);
        """
    )
    assert found == [[["the paper", "all"], ["low", "top"]], *[[["all"], ["top"]]] * 2]


def test_the_evaluation_that_stands_for_a_job(page: Browser) -> None:
    """The command line and the service choose the same one: most episodes, then newest."""
    chosen = page.module(
        """
        const { representative } = await import("/ui/js/evaluation.js");
        const made = (id, state, episodes, finished_at) => ({ id, state, finished_at, summary: state === "succeeded" ? { episodes } : null });
        const all = [made("e", "failed", 5000, "2026-01-05"), made("d", "succeeded", 10, "2026-01-04"), made("c", "succeeded", 1000, "2026-01-03"), made("b", "succeeded", 1000, "2026-01-02")];
        return [representative(all).id, representative(all.slice(0, 1))];
        """  # noqa: E501
    )
    assert chosen == ["c", None]


def test_a_running_job_shows_training_and_an_ended_one_its_evaluation(page: Browser) -> None:
    shown = page.module(
        """
        const { shownMetric } = await import("/ui/js/jobs.js");
        const job = (state) => ({ state, latest_metrics: { speed_mps: 1 }, result: { results: [{ name: "speed_mps", value: 2, interval: [1, 3] }] } });
        return [shownMetric(job("running"), { name: "speed_mps" }), shownMetric(job("succeeded"), { name: "speed_mps" })];
        """  # noqa: E501
    )
    assert shown == [
        {"value": 1, "interval": None, "training": True},
        {"value": 2, "interval": [1, 3], "training": False},
    ]


def test_the_gait_of_a_fallen_episode_says_so(page: Browser) -> None:
    notes = page.module(
        """
        const { fallNote } = await import("/ui/js/evaluation.js");
        return [fallNote({ failed: true }, "1.25"), fallNote({ failed: false }, "8.00")];
        """
    )
    assert notes == ["ended in a fall after 1.25 s; the values below include the fall", None]
