//! Textures and pictures: what `palpate texture` and `palpate render` make.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods, missing_docs)]

use std::path::Path;
use std::process::{Command, Output};

use palpate_refusal::Reason;
use palpate_texture::{Image, image, painted, texture};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{Appearance, Named, PAPER, PaintedSurface, Scene};

fn palpate(arguments: &[&str]) -> Output {
    let program = env!("CARGO_BIN_EXE_palpate");
    Command::new(program).args(arguments).current_dir(env!("CARGO_MANIFEST_DIR")).output().unwrap()
}

/// The file that a command makes, in a folder that goes away.
fn made(name: &str, arguments: &[&str]) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    let output = palpate(&[arguments, &["--output", path.to_str().unwrap()]].concat());
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    std::fs::read(path).unwrap()
}

fn refused(arguments: &[&str], named: &str) {
    let output = palpate(arguments);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!((output.status.code(), told.contains(named)), (Some(2), true), "{arguments:?}: {told}");
}

fn decoded(bytes: &[u8]) -> Image {
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
    let frame = reader.next_frame(&mut rgb).unwrap();
    assert_eq!(frame.color_type, png::ColorType::Rgb);
    Image { width: frame.width as usize, height: frame.height as usize, rgb }
}

fn pixel(image: &Image, x: usize, y: usize) -> [u8; 3] {
    std::array::from_fn(|c| image.rgb[3 * (y * image.width + x) + c])
}

/// Mean red, green and blue of a square part, one of `parts` × `parts`.
fn mean(image: &Image, parts: usize, [column, row]: [usize; 2]) -> [f64; 3] {
    let side = image.width / parts;
    let mut sum = [0.0; 3];
    for y in row * side..(row + 1) * side {
        for x in column * side..(column + 1) * side {
            let pixel = pixel(image, x, y);
            (0..3).for_each(|c| sum[c] += f64::from(pixel[c]) / (side * side) as f64);
        }
    }
    sum
}

#[test]
fn a_texture_is_made_by_its_seed() {
    let first = made("a.png", &["texture", "--seed", "5", "--size", "96"]);
    assert_eq!(first, made("b.png", &["texture", "--seed", "5", "--size", "96"]));
    assert_ne!(first, made("c.png", &["texture", "--seed", "6", "--size", "96"]));
    let small = decoded(&first);
    assert_eq!((small.width, small.height), (96, 96));
    // The lining of a stomach: red, and neither flat nor noise. Only colour differs, not light.
    let large = painted(PaintedSurface::Mucosa, 5, 384, &Limits::default()).unwrap();
    let mut spread = 0.0_f64;
    for part in (0..64).map(|k| [k % 8, k / 8]) {
        let [a, b] = [mean(&small, 8, part), mean(&large, 8, part)];
        assert!(a[0] > 1.2 * a[1] && a[1] > 0.7 * a[2], "{a:?}");
        // The same tissue, sharper.
        assert!((0..3).all(|c| (a[c] - b[c]).abs() < 14.0), "{part:?}: {a:?} and {b:?}");
        spread = spread.max((a[0] - mean(&small, 1, [0, 0])[0]).abs());
    }
    assert!(spread > 7.0, "{spread}");
    refused(&["texture", "--size", "4097", "--output", "never.png"], "texture_size");
    refused(&["texture", "--size", "3", "--output", "never.png"], "from 16 to 4096");
    let nowhere = palpate(&["texture", "--size", "16", "--output", "no/such/folder/a.png"]);
    assert_eq!(nowhere.status.code(), Some(1));
}

#[test]
fn each_tissue_has_a_surface_of_its_own() {
    let limits = Limits::default();
    let mut means = Vec::new();
    for (name, surface) in
        [("liver", "liver"), ("fibrotic", "nodular"), ("stomach", "mucosa"), ("gallbladder", "serosa")]
    {
        let scene = Scene::load(&Path::new("scenes").join(format!("{name}.toml")), &[], &limits).unwrap();
        assert_eq!(scene.appearance.surface.name(), surface);
        let small = Appearance { texture_size: 192, ..scene.appearance };
        let painted = image(&small, &limits).unwrap();
        let program = made("a.png", &["texture", "--surface", surface, "--size", "192"]);
        assert_eq!(painted, decoded(&program), "{name}");
        means.push(mean(&painted, 1, [0, 0]));
    }
    // A liver is dark, its scarred one paler and yellower, the lining of a stomach pink.
    let [liver, nodular, mucosa] = [means[0], means[1], means[2]];
    assert!(liver[0] < nodular[0] - 20.0 && nodular[0] < mucosa[0] - 15.0, "{means:?}");
    assert!(nodular[1] / nodular[2] > 1.05 * liver[1] / liver[2], "{means:?}");
    // A gallbladder is grey-green: green before red, and far from the pink of a lining.
    let serosa = means[3];
    assert!(serosa[1] > serosa[0] && serosa[1] > serosa[2] && serosa[1] < 1.4 * serosa[0], "{means:?}");
    assert_eq!(Appearance::default().surface, PaintedSurface::Mucosa);
    refused(&["texture", "--surface", "spleen", "--output", "never.png"], "surface");
}

/// A scene whose own image is of these pixels, rows from the top.
fn scene_with_image(folder: &Path, width: usize, rgb: &[[u8; 3]]) -> String {
    let own = Image { width, height: rgb.len() / width, rgb: rgb.concat() };
    std::fs::write(folder.join("own.png"), own.png().unwrap()).unwrap();
    let path = folder.join("own.toml");
    std::fs::write(&path, format!("{PAPER}\n[appearance]\ntexture = \"own.png\"\n")).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_scene_may_have_an_image_of_its_own() {
    let (folder, limits) = (tempfile::tempdir().unwrap(), Limits::default());
    let path = scene_with_image(folder.path(), 2, &[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]);
    let scene = Scene::load(Path::new(&path), &[], &limits).unwrap();
    let served = texture(&scene.appearance, &limits).unwrap();
    assert_eq!(served.png, std::fs::read(folder.path().join("own.png")).unwrap());
    let standard = texture(&Appearance::default(), &limits).unwrap();
    assert_eq!(standard, texture(&Appearance::default(), &limits).unwrap());
    assert_ne!(standard.etag, served.etag);
    assert_eq!(decoded(&standard.png), image(&Appearance::default(), &limits).unwrap());

    std::fs::write(folder.path().join("own.png"), "no image").unwrap();
    let wrong = texture(&scene.appearance, &limits).unwrap_err();
    assert_eq!((wrong.reason, wrong.field.as_str()), (Reason::Unreadable, "appearance.texture"));
    assert!(wrong.to_string().contains("own.png"), "{wrong}");
    std::fs::remove_file(folder.path().join("own.png")).unwrap();
    assert_eq!(texture(&scene.appearance, &limits).unwrap_err().reason, Reason::Unreadable);
    let large = Image { width: 5000, height: 1, rgb: vec![0; 15_000] };
    std::fs::write(folder.path().join("own.png"), large.png().unwrap()).unwrap();
    assert_eq!(texture(&scene.appearance, &limits).unwrap_err().reason, Reason::TooLarge);

    for (lines, reason, field) in [
        ("texture_size = 5", Reason::OutOfRange, "appearance.texture_size"),
        ("texture_seed = -1", Reason::OutOfRange, "appearance.texture_seed"),
        ("texture = 7", Reason::WrongKind, "appearance.texture"),
        ("texture = \"own.png\"\ntexture_seed = 3", Reason::WrongKind, "appearance.texture"),
        ("texture = \"own.png\"\nsurface = \"liver\"", Reason::WrongKind, "appearance.texture"),
        ("surface = \"spleen\"", Reason::WrongKind, "appearance.surface"),
        ("colour = \"red\"", Reason::UnknownKey, "appearance.colour"),
    ] {
        let text = format!("{PAPER}\n[appearance]\n{lines}\n");
        let refusal = Scene::parse("test", &text, &[], &limits).unwrap_err();
        assert_eq!((refusal.reason, refusal.field.as_str()), (reason, field), "{lines}");
    }
}

const SMALL: [&str; 4] = ["--size", "96x72", "--set", "appearance.texture_size=64"];

fn poke(more: &[&str]) -> Vec<u8> {
    made("a.png", &[&["render", "paper", "oblique-100"], &SMALL[..], more].concat())
}

#[test]
fn a_picture_is_the_same_on_every_run_and_width_of_vectors() {
    let first = poke(&[]);
    assert_eq!(first, poke(&[]));
    assert_eq!(first, poke(&["--set", "stepping.lanes=plain"]));
    // The deepest moment is not one of rest.
    assert_ne!(first, poke(&["--at-s", "0"]));
    assert_ne!(first, poke(&["--camera", "-40,60,2"]));
    assert_ne!(first, poke(&["--wireframe"]));
    assert_ne!(poke(&["--wireframe"]), poke(&["--wireframe", "--refine", "1"]));
}

#[test]
fn the_image_lies_on_the_sheet_as_it_should() {
    let folder = tempfile::tempdir().unwrap();
    let corners = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]];
    let scene = scene_with_image(folder.path(), 2, &corners);
    let at_rest = ["--at-s", "0", "--size", "120x90", "--camera", "0,90"];
    let seen = decoded(&made("a.png", &[&["render", &scene, "vertical-60"], &at_rest[..]].concat()));
    // From above, x to the right and y up.
    let strongest = |x: usize, y: usize| {
        let pixel = pixel(&seen, x, y);
        // Light on what is wet is white.
        pixel.map(|value| value > pixel.iter().max().unwrap() - 40)
    };
    let (left, right, top, bottom) = (36, 84, 22, 68);
    assert_eq!(strongest(left, top), [true, false, false], "{:?}", pixel(&seen, left, top));
    assert_eq!(strongest(right, top), [false, true, false], "{:?}", pixel(&seen, right, top));
    assert_eq!(strongest(left, bottom), [false, false, true], "{:?}", pixel(&seen, left, bottom));
    assert_eq!(strongest(right, bottom), [true, true, false], "{:?}", pixel(&seen, right, bottom));
    // Beside the sheet there is nothing.
    assert_eq!(pixel(&seen, 1, 1), pixel(&seen, 118, 88));
}

#[test]
fn a_wound_is_open_between_two_lips_and_nothing_else_changes() {
    let view = ["--camera", "0,90", "--size", "400x300", "--set", "appearance.texture_size=64"];
    let gapes = ["--set", "springs.pretension_n_per_m=2.0", "--set", "cutting.toughness_j_per_m2=0.0"];
    let of = |more: &[&str]| decoded(&made("a.png", &[&["render", "liver", "cut"], &view[..], &gapes, more].concat()));
    // Before the blade is in the tissue, and after it has left.
    for more in [&[][..], &["--refine", "0"], &["--wireframe"]] {
        let [whole, cut] = ["0", "1.85"].map(|at_s| of(&[&["--at-s", at_s], more].concat()));
        let darker = |x: usize, y: usize| {
            let light = |image: &Image| pixel(image, x, y).into_iter().map(u32::from).sum::<u32>();
            light(&cut) * 4 < light(&whole) * 3
        };
        // The cut is 30 mm of 75 mm long, along y in the middle.
        let rows: Vec<Vec<usize>> = (0..300).map(|y| (0..400).filter(|x| darker(*x, y)).collect()).collect();
        let open: Vec<usize> = (0..300).filter(|y| !rows[*y].is_empty()).collect();
        assert!((60..140).contains(&open.len()), "{more:?}: {open:?}");
        let (first, last) = (open[0], open[open.len() - 1]);
        assert!(last - first < open.len() + 6, "{more:?}: {open:?}");
        let columns: Vec<usize> = rows.iter().flatten().copied().collect();
        let (left, right) = (columns.iter().min().unwrap(), columns.iter().max().unwrap());
        // A few pixels wide: it is not a stretched row of cells, each of 6 pixels.
        // As a net, the springs that are left end at the lips.
        let most = if more == ["--wireframe"] { 80 } else { 16 };
        assert!((1..most).contains(&(right - left)), "{more:?}: columns {left} to {right}");
    }
}

#[test]
fn what_a_tip_burns_is_dark_and_nothing_else_is() {
    let folder = tempfile::tempdir().unwrap();
    // Burnt for two thirds of the time in which it burns through, and left alone.
    let script = folder.path().join("burn.toml");
    let text = "duration_s = 1.0\nsample_every_s = 0.1\n[[tool]]\ntip = { radius_m = 0.006, grasps = true, burn_s = 0.3 }\n\
                poses = [{ at_s = 0.0, place_m = [0.0375, 0.0375, 0.0] }]\nuntil_s = 0.2\n";
    std::fs::write(&script, text).unwrap();
    let view = ["--camera", "0,90", "--size", "200x150", "--set", "appearance.texture_size=64"];
    // As a net the surface is pale, and stays paler.
    for (more, tenths) in [(&[][..], 7), (&["--wireframe"], 9)] {
        let of = |at_s: &str| {
            let arguments = [&["render", "liver", script.to_str().unwrap(), "--at-s", at_s], &view[..], more].concat();
            decoded(&made("a.png", &arguments))
        };
        let [whole, burnt] = ["0", "1"].map(of);
        let light = |image: &Image, x: usize, y: usize| pixel(image, x, y).into_iter().map(u32::from).sum::<u32>();
        let darker = |x: usize, y: usize| 10 * light(&burnt, x, y) < tenths * light(&whole, x, y);
        let dark: Vec<[usize; 2]> =
            (0..150).flat_map(|y| (0..200).map(move |x| [x, y])).filter(|[x, y]| darker(*x, *y)).collect();
        // A disc of some 12 of 75 mm.
        assert!((100..1000).contains(&dark.len()), "{more:?}: {}", dark.len());
        assert!(dark.iter().all(|[x, y]| x.abs_diff(96) < 25 && y.abs_diff(66) < 25), "{more:?}: {dark:?}");
    }
}

#[test]
fn a_dent_shows_where_the_force_is() {
    let view = ["--camera", "0,90", "--size", "96x72", "--set", "appearance.texture_size=64"];
    let of = |more: &[&str]| decoded(&made("a.png", &[&["render", "paper", "vertical-60"], &view[..], more].concat()));
    let (rest, poked) = (of(&["--at-s", "0"]), of(&["--at-s", "0.5"]));
    let differs = |x: usize, y: usize| {
        let pairs = pixel(&rest, x, y).into_iter().zip(pixel(&poked, x, y));
        pairs.map(|(a, b)| a.abs_diff(b)).max().unwrap()
    };
    let changed = |x: std::ops::Range<usize>, y: std::ops::Range<usize>| {
        x.flat_map(|x| y.clone().map(move |y| (x, y))).map(|(x, y)| differs(x, y)).max().unwrap()
    };
    assert!(changed(40..56, 28..44) > 40);
    // The rim is far away.
    assert!(changed(22..30, 10..18) <= 2);
}

#[test]
fn a_film_lasts_as_long_as_its_script() {
    let film =
        made("a.gif", &["render", "paper", "vertical-60", "--size", "64x48", "--wireframe", "--frames-hz", "20"]);
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(&film[..]).unwrap();
    assert_eq!((decoder.width(), decoder.height()), (64, 48));
    let mut frames = Vec::new();
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        assert_eq!(frame.delay, 5);
        frames.push(frame.buffer.to_vec());
    }
    // 0, 0.05, …, 1 s.
    assert_eq!(frames.len(), 21);
    assert_ne!(frames[0], frames[6]);
    let again =
        made("b.gif", &["render", "paper", "vertical-60", "--size", "64x48", "--wireframe", "--frames-hz", "20"]);
    assert_eq!(film, again);
}

#[test]
fn what_can_not_be_drawn_is_refused_by_its_name() {
    let with = |more: &[&str], named: &str| {
        refused(&[&["render", "paper", "vertical-60"], more].concat(), named);
    };
    with(&["--output", "poke.jpg"], "--output");
    with(&["--output", "a.png", "--size", "10x10"], "--size");
    with(&["--output", "a.png", "--size", "large"], "--size");
    with(&["--output", "a.png", "--camera", "1"], "camera");
    with(&["--output", "a.png", "--camera", "0,200"], "camera elevation");
    with(&["--output", "a.png", "--camera", "0,nan"], "camera elevation");
    with(&["--output", "a.png", "--at-s", "1.5"], "--at-s");
    with(&["--output", "a.gif", "--at-s", "0.5"], "--at-s");
    with(&["--output", "a.gif", "--frames-hz", "0"], "--frames-hz");
    with(&["--output", "a.png", "--refine", "11"], "refinement");
    refused(&["render", "paper", "no-such-script", "--output", "a.png"], "no-such-script");
}
