//! The worked TPDO1 frames of the DST P92C (V-DST-01..10), decoded by a mapping in which units and digits stand: bytes in,
//! values out, and what is said against them. No SDO is spoken.

use cangate::mapping::{Sketch, SourceText};
use cangate::process_image::{Quality, Reason, Value};

use super::support::conversation::Conversation;

/// One worked frame.
struct Example {
    node: u8,
    maps: &'static [&'static str],
    /// Decimal digits of the integer objects: pressure, temperature.
    digits: [u32; 2],
    units: [&'static str; 2],
    frame: &'static str,
    /// Tags, and what they show then; of the status bytes also their three bits, as 0 or 1.
    values: &'static [(&'static str, f64)],
    /// What is said against tags; against all others nothing.
    objections: &'static [(&'static str, &'static str)],
    /// Alarms that are raised.
    alarms: &'static [&'static str],
}

/// Pressure and its status in Pa, which is what the device sends from the factory.
const FACTORY: Example = Example {
    node: 1,
    maps: &["0x9130:1/32", "0x6150:1/8"],
    digits: [0, 0],
    units: ["Pa", "°C"],
    frame: "181#A086010000",
    values: &[("pressure", 100_000.0), ("pressure_status", 0.0)],
    objections: &[],
    alarms: &[],
};

/// What stands in the mapping about a status byte.
fn status(name: &str, sub: usize) -> String {
    format!(
        r#"
[[tag]]
name = "{name}_status"
object = "0x6150:{sub}"
type = "u8"
[[derived]]
name = "{name}_{{}}"
array = {{ words = ["invalid", "overload_pos", "overload_neg"] }}
bit = {{ of = "{name}_status", bit = 0 }}
[[derived]]
name = "{name}_valid"
when = "not {name}_invalid"
[[derived]]
name = "{name}_overload"
when = "{name}_overload_pos or {name}_overload_neg"
[[alarm]]
name = "{name}_{{}}"
array = {{ words = ["invalid", "overload_pos", "overload_neg"] }}
when = "{name}_{{}}"
priority = "high"
text = "x"
action = "y"
"#
    )
}

/// What stands in the mapping about one channel.
fn channel(example: &Example, channel: usize, name: &str) -> String {
    let sub = channel + 1;
    let is_mapped = |index: &str, bits: u8| example.maps.contains(&format!("{index}:{sub}/{bits}").as_str());
    let scale = format!("scale = {{ divide = {} }}\n", 10_u32.pow(example.digits[channel]));
    let trust = format!("valid = '{name}_valid'\ndoubtful = '{name}_overload'\n");
    let (trust, status) =
        if is_mapped("0x6150", 8) { (trust, status(name, sub)) } else { <(String, String)>::default() };
    let values = [("0x6130", "f32", ""), ("0x9130", "i32", scale.as_str())];
    let tags = values.into_iter().filter(|(index, ..)| is_mapped(index, 32)).map(|(index, kind, scale)| {
        let unit = example.units[channel];
        format!(
            "[[tag]]\nname = '{name}'\nobject = '{index}:{sub}'\ntype = '{kind}'\n{scale}unit = '{unit}'\n{trust}"
        )
    });
    tags.chain([status]).collect::<Vec<_>>().concat()
}

/// A mapping with a tag for everything that is mapped.
fn mapping(example: &Example) -> String {
    let maps = example.maps;
    let head = format!(
        "format = 1\ndevice = {{ vendor = 'x', model = 'y' }}\nerror_control = {{ kind = 'none' }}\n\
         start = {{ auto_start = false }}\n[tpdo.1]\ncob_id = '$NODEID+0x180'\nmaps = {maps:?}\nmapping = 'fixed'\n\
         timeout_ms = 3000\n"
    );
    [head, channel(example, 0, "pressure"), channel(example, 1, "temperature")].concat()
}

fn conversation(example: &Example) -> Conversation {
    let sketch = Sketch::new().mapping(SourceText::new("worked", mapping(example))).node(
        "press",
        example.node,
        "worked",
        |_| (),
    );
    Conversation::new(sketch.build().unwrap_or_else(|problems| panic!("{problems:#?}")).0)
}

/// What is said against each published tag of which something is.
fn objections(conversation: &Conversation) -> Vec<(String, &'static str)> {
    let tags = conversation.table.tags.iter().zip(&conversation.image.tags);
    let numbers = tags.filter(|(tag, _)| ["pressure", "temperature"].contains(&tag.name.as_str()));
    numbers
        .filter_map(|(tag, sample)| {
            Some((tag.name.clone(), tag.objection(&conversation.image, sample)?.word()))
        })
        .collect()
}

fn check(example: &Example) {
    let mut conversation = conversation(example);
    conversation.frame(example.frame);
    for (tag, expected) in example.values {
        let shown = conversation.tag(tag).value.as_f64();
        assert!(
            (shown - expected).abs() < 1e-9 || (shown.is_nan() && expected.is_nan()),
            "{}: {tag} {shown}",
            example.frame
        );
    }
    for (tag, unit) in ["pressure", "temperature"].into_iter().zip(example.units) {
        let found = conversation.table.tags.iter().find(|def| def.name == tag);
        assert!(found.is_none_or(|def| def.unit == unit), "{}: {tag}", example.frame);
    }
    let expected: Vec<_> = example.objections.iter().map(|(tag, word)| ((*tag).to_owned(), *word)).collect();
    assert_eq!(objections(&conversation), expected, "{}", example.frame);
    assert_eq!(conversation.raised(), example.alarms, "{}", example.frame);
}

#[test]
fn v_dst_01_r_dst_012_014_025_the_frame_of_a_factory_device() {
    check(&FACTORY);
}

#[test]
fn v_dst_02_04_05_r_dst_025_026_status_bits_say_how_far_the_pressure_can_be_trusted() {
    for example in [
        Example {
            frame: "181#18FCFFFF04",
            values: &[("pressure", -1000.0), ("pressure_status", 4.0), ("pressure_overload_neg", 1.0)],
            objections: &[("pressure", "doubtful")],
            alarms: &["pressure_overload_neg"],
            ..FACTORY
        },
        Example {
            digits: [1, 0],
            units: ["mbar", "°C"],
            frame: "181#50C3000002",
            values: &[("pressure", 5000.0), ("pressure_overload_pos", 1.0), ("pressure_overload_neg", 0.0)],
            objections: &[("pressure", "doubtful")],
            alarms: &["pressure_overload_pos"],
            ..FACTORY
        },
        // Bits 3 to 7 are kept and mean nothing.
        Example {
            frame: "181#FFFFFF7FF9",
            values: &[
                ("pressure", 2_147_483_647.0),
                ("pressure_status", 249.0),
                ("pressure_invalid", 1.0),
                ("pressure_overload", 0.0),
            ],
            objections: &[("pressure", "not_valid")],
            alarms: &["pressure_invalid"],
            ..FACTORY
        },
    ] {
        check(&example);
    }
}

#[test]
fn v_dst_03_04_07_09_r_dst_016_032_an_integer_is_divided_by_its_digits_and_a_float_is_not() {
    check(&Example {
        digits: [3, 0],
        units: ["bar", "°C"],
        frame: "181#3930000000",
        values: &[("pressure", 12.345)],
        ..FACTORY
    });
    check(&Example {
        node: 5,
        maps: &["0x9130:1/32", "0x6150:1/8", "0x6150:2/8"],
        digits: [2, 1],
        units: ["psi", "°F"],
        frame: "185#40E201000000",
        values: &[("pressure", 1234.56), ("pressure_status", 0.0), ("temperature_status", 0.0)],
        ..FACTORY
    });
    check(&Example {
        maps: &["0x9130:2/32", "0x6150:2/8"],
        digits: [0, 2],
        frame: "181#60F0FFFF00",
        values: &[("temperature", -40.0), ("temperature_status", 0.0)],
        ..FACTORY
    });
    check(&Example {
        maps: &["0x6130:1/32", "0x9130:2/32"],
        digits: [3, 0],
        units: ["bar", "°C"],
        frame: "181#0000C03F19000000",
        values: &[("pressure", 1.5), ("temperature", 25.0)],
        ..FACTORY
    });
}

#[test]
fn v_dst_06_08_r_dst_015_016_037_floats_in_the_order_in_which_they_are_mapped() {
    check(&Example {
        maps: &["0x6130:1/32", "0x9130:2/32"],
        units: ["bar", "°C"],
        frame: "181#0000C03F19000000",
        values: &[("pressure", 1.5), ("temperature", 25.0)],
        ..FACTORY
    });
    check(&Example {
        maps: &["0x9130:2/32", "0x6130:1/32"],
        units: ["bar", "°C"],
        frame: "181#190000000000C03F",
        values: &[("pressure", 1.5), ("temperature", 25.0)],
        ..FACTORY
    });
    check(&Example {
        maps: &["0x6130:1/32", "0x6130:2/32"],
        units: ["bar", "°F"],
        frame: "181#0000C07F00004842",
        values: &[("pressure", f64::NAN), ("temperature", 50.0)],
        objections: &[("pressure", "not_a_number")],
        ..FACTORY
    });
}

#[test]
fn r_dst_026_without_a_status_the_value_is_as_good_as_the_communication() {
    let mut conversation = conversation(&Example { maps: &["0x9130:1/32"], ..FACTORY });
    conversation.frame("181#A0860100");
    assert_eq!(conversation.tag("pressure").quality, Quality::Good);
    conversation.run_to(3001);
    assert_eq!(conversation.tag("pressure").quality, Quality::Stale(Reason::PdoTimeout));
    assert_eq!(objections(&conversation), [("pressure".to_owned(), "pdo_timeout")]);
}

#[test]
fn v_dst_10_r_dst_027_a_short_frame_is_discarded_and_a_long_one_read_from_its_first_bytes() {
    for (frame, discarded) in [("181#A0860100", true), ("181#", true), ("181#A086010000FFFFFF", false)] {
        let mut conversation = conversation(&FACTORY);
        conversation.frame("181#0100000000");
        conversation.run_to(2000);
        conversation.frame(frame);
        let expected = if discarded { 1 } else { 100_000 };
        assert_eq!(conversation.tag("pressure").value, Value::Signed(expected), "{frame}");
        let counters = &conversation.node().counters;
        assert_eq!((counters.pdo_length_errors, counters.frames_received), (1, 2), "{frame}");
        conversation.run_to(4000);
        assert_eq!(
            conversation.tag("pressure").quality.is_good(),
            !discarded,
            "{frame}: its timeout runs on"
        );
    }
}

#[test]
fn v_dst_10_r_dst_027_strict_dlc_discards_what_is_too_long() {
    let sketch = Sketch::new().mapping(SourceText::new("worked", mapping(&FACTORY))).node(
        "press",
        1,
        "worked",
        |node| node.strict_dlc = Some(true),
    );
    let mut conversation = Conversation::new(sketch.build().unwrap().0);
    conversation.frame("181#A086010000FFFFFF");
    assert_eq!(conversation.tag("pressure").quality, Quality::NEVER);
    conversation.frame("181#A086010000");
    assert_eq!(conversation.tag("pressure").quality, Quality::Good);
}

#[test]
fn r_dst_048_a_thousand_frames_a_second_are_all_decoded() {
    let mut conversation = conversation(&FACTORY);
    for millis in 1..=3000_u32 {
        conversation.run_to(u64::from(millis));
        let [a, b, ..] = millis.to_le_bytes();
        conversation.frame(&format!("181#{a:02X}{b:02X}000000"));
        assert_eq!(conversation.tag("pressure").value, Value::Signed(i64::from(millis)));
        assert!(conversation.tag("pressure").quality.is_good());
    }
    assert_eq!(conversation.node().counters.frames_received, 3000);
    assert_eq!(conversation.raised(), [""; 0]);
}
