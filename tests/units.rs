//! Units and decimal digits that a device tells: the gateway against the simulated DST P92C, and the worked frames of its
//! requirements (V-DST-01 to V-DST-09).

use std::sync::Arc;

use cangate::can::{BusEvent, BusIndex, CanFrame, Link};
use cangate::canopen::NodeId;
use cangate::gateway::{Action, Gateway, Input, Outcome};
use cangate::mapping::installation::RoleWord;
use cangate::mapping::{Sketch, SourceText, TagTable, check_mapping};
use cangate::modbus::{ModbusSettings, RegisterMap};
use cangate::mqtt::payload::{self, Stamp};
use cangate::process_image::{NodeIndex, ProcessImage, Quality, Reason, Sample};
use cangate::simulator::{DevicePlan, Kind, Scenario};
use cangate::time::Now;
use cangate::web::status::NodeView;

use super::support::world::World;

/// A transmitter whose TPDO carries some objects, set to a unit and digits. Tags of both channels, each in the device's unit
/// and in a certain one.
fn mapping(maps: &str, pressure: (u32, u8), temperature: (u32, u8)) -> String {
    let setup = |object: &str, kind: &str, value: u32| {
        format!("[[setup]]\nobject = \"{object}\"\ntype = \"{kind}\"\nvalue = {value}\n")
    };
    let tag = |name: &str, object: &str, kind: &str, unit: &str, channel: u8| {
        let digits =
            if kind == "i32" { format!("digits_object = \"0x6132:{channel}\"\n") } else { String::new() };
        let mapped = maps.contains(object);
        let entry = format!(
            "[[tag]]\nname = \"{name}\"\nobject = \"{object}\"\ntype = \"{kind}\"\nunit = \"{unit}\"\ndecimals = 5\n\
             unit_object = \"0x6131:{channel}\"\n{digits}"
        );
        if mapped { entry } else { String::new() }
    };
    let status = |name: &str, object: &str| {
        if maps.contains(object) {
            format!("[[tag]]\nname = \"{name}\"\nobject = \"{object}\"\ntype = \"u8\"\n")
        } else {
            String::new()
        }
    };
    [
        "format = 1\n[device]\nvendor = \"Example\"\nmodel = \"P\"\n[error_control]\nkind = \"heartbeat\"\nheartbeat_ms = 500\n"
            .to_owned(),
        format!("[tpdo.1]\ncob_id = \"$NODEID+0x180\"\nmaps = [{maps}]\ntransmission_type = 255\nevent_timer_ms = 100\n"),
        setup("0x6131:1", "u32", pressure.0),
        setup("0x6132:1", "u8", pressure.1.into()),
        setup("0x6131:2", "u32", temperature.0),
        setup("0x6132:2", "u8", temperature.1.into()),
        tag("pressure", "0x9130:1", "i32", "device", 1),
        tag("pressure_pa", "0x9130:1", "i32", "Pa", 1),
        tag("pressure", "0x6130:1", "f32", "device", 1),
        tag("pressure_pa", "0x6130:1", "f32", "Pa", 1),
        tag("temperature", "0x9130:2", "i32", "device", 2),
        tag("temperature_c", "0x9130:2", "i32", "°C", 2),
        tag("temperature", "0x6130:2", "f32", "device", 2),
        tag("temperature_c", "0x6130:2", "f32", "°C", 2),
        status("pressure_status", "0x6150:1"),
        status("temperature_status", "0x6150:2"),
    ]
    .concat()
}

const DEFAULT: &str = r#""0x9130:1/32", "0x6150:1/8""#;
const PA: u32 = 0x0022_0000;
const BAR: u32 = 0x004E_0000;
const MBAR: u32 = 0xFD4E_0000;
const PSI: u32 = 0x00AB_0000;
const CELSIUS: u32 = 0x002D_0000;
const FAHRENHEIT: u32 = 0x00AC_0000;

fn table(text: &str, node: u8, role: RoleWord) -> Arc<TagTable> {
    let name = format!("node{node:03}");
    let sketch = Sketch::new().mapping(SourceText::new("own", text)).node(&name, node, "own", |_| ());
    let (table, _) = sketch.bus(|bus| bus.role = role).build().unwrap_or_else(|why| panic!("{why:#?}"));
    Arc::new(table)
}

/// A bus with a gateway that only listens, and one frame on it.
struct Heard {
    table: Arc<TagTable>,
    image: ProcessImage,
}

impl Heard {
    fn new(frame: &str, text: &str) -> Self {
        Self::by(RoleWord::Passive, frame, text)
    }

    fn by(role: RoleWord, frame: &str, text: &str) -> Self {
        let frame: CanFrame = frame.parse().unwrap();
        let node = u8::try_from(u32::from_str_radix(&frame.to_string()[..3], 16).unwrap() - 0x180).unwrap();
        let table = table(text, node, role);
        let mut gateway = Gateway::new(Arc::clone(&table), Now::from_millis(0));
        let mut image = gateway.empty_image();
        let at = Now::from_millis(1);
        for event in [BusEvent::Link { link: Link::ErrorActive, at }, BusEvent::Frame { frame, at }] {
            gateway.handle_input(at, Input::Bus { bus: BusIndex(0), event });
            while gateway.poll_output().is_some() {}
        }
        gateway.publish(&mut image);
        Self { table, image }
    }

    fn tag(&self, name: &str) -> &Sample {
        self.image.tag(self.table.find_tag(NodeIndex(0), name).unwrap())
    }

    fn unit(&self, name: &str) -> &str {
        &self.image.units[&self.table.find_tag(NodeIndex(0), name).unwrap()]
    }

    #[track_caller]
    fn assert(&self, name: &str, expected: f64) {
        let sample = self.tag(name);
        let number = sample.value.as_f64();
        assert!(
            (number - expected).abs() <= 1e-9 * expected.abs().max(1.0),
            "{name}: {number}, not {expected}"
        );
        assert_eq!(sample.quality, Quality::Good, "{name}");
    }
}

#[test]
fn v_dst_01_to_05_pressures_in_pa_bar_and_mbar() {
    for (frame, unit, digits, value, text, pa, status) in [
        ("181#A086010000", PA, 0, 100_000.0, "Pa", 100_000.0, 0x00),
        ("181#18FCFFFF04", PA, 0, -1000.0, "Pa", -1000.0, 0x04),
        ("181#3930000000", BAR, 3, 12.345, "bar", 1_234_500.0, 0x00),
        ("181#50C3000002", MBAR, 1, 5000.0, "mbar", 500_000.0, 0x02),
        ("181#FFFFFF7FF9", PA, 0, 2_147_483_647.0, "Pa", 2_147_483_647.0, 0xF9),
    ] {
        let heard = Heard::new(frame, &mapping(DEFAULT, (unit, digits), (CELSIUS, 0)));
        heard.assert("pressure", value);
        heard.assert("pressure_pa", pa);
        heard.assert("pressure_status", f64::from(status));
        assert_eq!(heard.unit("pressure"), text, "{frame}");
    }
}

#[test]
fn v_dst_06_r_dst_031_032_digits_do_not_apply_to_the_float_but_the_unit_does() {
    let text = mapping(r#""0x6130:1/32", "0x9130:2/32""#, (BAR, 3), (CELSIUS, 0));
    let heard = Heard::new("181#0000C03F19000000", &text);
    heard.assert("pressure", 1.5);
    heard.assert("pressure_pa", 150_000.0);
    heard.assert("temperature_c", 25.0);
    assert_eq!((heard.unit("pressure"), heard.unit("temperature")), ("bar", "°C"));
}

#[test]
fn v_dst_07_psi_with_two_digits_of_node_5() {
    let maps = r#""0x9130:1/32", "0x6150:1/8", "0x6150:2/8""#;
    let heard = Heard::new("185#40E201000000", &mapping(maps, (PSI, 2), (FAHRENHEIT, 1)));
    heard.assert("pressure", 1234.56);
    assert!((heard.tag("pressure_pa").value.as_f64() - 8_511_991.564).abs() < 0.001);
    assert_eq!(heard.unit("pressure"), "psi");
}

#[test]
fn v_dst_08_r_dst_037_fahrenheit_beside_a_pressure_that_is_no_number() {
    let text = mapping(r#""0x6130:1/32", "0x6130:2/32""#, (BAR, 0), (FAHRENHEIT, 0));
    let heard = Heard::new("181#0000C07F00004842", &text);
    for tag in ["pressure", "pressure_pa"] {
        assert_eq!(heard.tag(tag).quality, Quality::Bad(Reason::NotANumber), "{tag}");
    }
    heard.assert("temperature", 50.0);
    heard.assert("temperature_c", 10.0);
    let mut state = String::new();
    let stamp = Stamp { sid: "s", seq: 1 };
    payload::state(&mut state, &heard.table, &heard.image, NodeIndex(0), stamp);
    let state: serde_json::Value = serde_json::from_str(&state).unwrap();
    assert!(state["tags"]["pressure"].is_null(), "{state}");
    assert_eq!(state["bad"]["pressure"], "not_a_number");
    assert_eq!(state["units"]["temperature"], "°F");
    assert!(state["units"]["temperature_c"].is_null(), "what is converted has the unit of the mapping");
}

#[test]
fn v_dst_09_a_negative_temperature_with_two_digits() {
    let text = mapping(r#""0x9130:2/32", "0x6150:2/8""#, (PA, 0), (CELSIUS, 2));
    let heard = Heard::new("181#60F0FFFF00", &text);
    heard.assert("temperature", -40.0);
    heard.assert("temperature_c", -40.0);
}

fn world(text: &str) -> World {
    let mut world = World::with(table(text, 2, RoleWord::Master), 1);
    let scenario = Scenario::shipped(Kind::DstP92c, "quiet").unwrap();
    world.connect(&DevicePlan::new(NodeId::new(2).unwrap(), scenario));
    world.order("node 2 pressure 100");
    world.run_for(1000);
    world.start_gateway();
    world.run_for(3000);
    world
}

fn unit(world: &World, tag: &str) -> String {
    world.image.units[&world.table.find_tag(NodeIndex(0), tag).unwrap()].clone()
}

#[test]
fn r_dst_028_030_034_035_a_register_of_pascals_holds_pascals_whatever_the_device_counts_in() {
    for (code, digits, shown, text) in
        [(PA, 0, 1e7, "Pa"), (BAR, 3, 100.0, "bar"), (MBAR, 1, 1e5, "mbar"), (PSI, 2, 1450.377, "psi")]
    {
        let world = world(&mapping(DEFAULT, (code, digits), (CELSIUS, 0)));
        assert_eq!(world.tag(2, "pressure_pa").quality, Quality::Good);
        let (pa, own) = (world.number(2, "pressure_pa"), world.number(2, "pressure"));
        assert!((pa - 1e7).abs() < 2e5, "{text}: {pa}");
        assert!((own - shown).abs() < shown * 0.02, "{text}: {own}");
        assert_eq!(unit(&world, "pressure"), text);
        assert!(world.raised.is_empty(), "{:?}", world.raised);
    }
}

#[test]
fn r_dst_034_no_value_is_made_before_its_unit_is_known_not_even_of_a_tpdo_that_is_believed() {
    let text = mapping(DEFAULT, (BAR, 3), (CELSIUS, 0)).replace("maps =", "mapping = \"fixed\"\nmaps =");
    let heard = Heard::by(RoleWord::Master, "181#3930000000", &text);
    assert_eq!(heard.tag("pressure_status").quality, Quality::Good, "the frame counts");
    for tag in ["pressure", "pressure_pa"] {
        assert_eq!(heard.tag(tag).quality, Quality::NEVER, "{tag}: nobody has said yet what it is in");
    }
    assert!(heard.image.units.is_empty());
    let world = world(&text);
    assert_eq!(world.tag(2, "pressure_pa").quality, Quality::NEVER, "no TPDO comes: nothing sets its type");
    assert_eq!(unit(&world, "pressure"), "bar");
}

#[test]
fn r_dst_036_an_unknown_unit_is_shown_raw_with_its_code_and_told_once() {
    let mut world = world(&mapping(DEFAULT, (BAR, 3), (CELSIUS, 0)));
    world.order("node 2 set 6131 1 0x01010000");
    world.run_for(30_000);
    let own = world.tag(2, "pressure");
    assert_eq!(own.quality, Quality::Uncertain(Reason::UnknownUnit));
    assert_eq!(own.raw.as_f64().to_bits(), own.value.as_f64().to_bits(), "the raw number");
    assert_eq!(unit(&world, "pressure"), "unknown(0x01010000)");
    assert_eq!(world.tag(2, "pressure_pa").quality, Quality::Bad(Reason::UnknownUnit), "it is not pascals");
    assert_eq!(world.events("unknown_unit"), 2, "once for each tag");
    world.order("node 2 set 6131 1 off");
    world.run_for(15_000);
    assert_eq!(world.tag(2, "pressure_pa").quality, Quality::Good);
}

#[test]
fn a_unit_that_is_changed_in_a_running_device_is_noticed_within_ten_seconds() {
    let mut world = world(&mapping(DEFAULT, (BAR, 3), (CELSIUS, 0)));
    assert_eq!(world.events("unit_changed"), 0);
    world.order(&format!("node 2 set 6131 1 {PSI}"));
    world.run_until(10_200, |world| unit(world, "pressure") == "psi");
    world.run_for(200);
    assert_eq!(world.events("unit_changed"), 2, "once for each tag");
    assert!((world.number(2, "pressure_pa") - 1e7).abs() < 2e5, "{}", world.number(2, "pressure_pa"));
    world.order(&format!("node 2 set 6131 1 {CELSIUS}"));
    world.run_for(11_000);
    assert_eq!(world.tag(2, "pressure_pa").quality, Quality::Bad(Reason::OtherUnit));
    assert_eq!(world.events("other_unit"), 1);
}

/// Objects with whole numbers beside 0x9130 of both channels; offset has no second channel.
const WHOLE_NUMBERS: [(&str, &str); 11] = [
    ("0x9124", "1"),
    ("0x9133", "1"),
    ("0x9133", "2"),
    ("0x9134", "1"),
    ("0x9134", "2"),
    ("0x9135", "1"),
    ("0x9135", "2"),
    ("0x9148", "1"),
    ("0x9148", "2"),
    ("0x9149", "1"),
    ("0x9149", "2"),
];

#[test]
fn r_dst_034_a_unit_that_is_written_through_the_gateway_holds_at_once_and_one_that_another_writes_soon() {
    let mut world = world(&mapping(DEFAULT, (BAR, 3), (CELSIUS, 0)));
    let write = |object: &str, data: Vec<u8>| {
        let object = object.parse().unwrap();
        Action::SdoWrite { node: NodeIndex(0), object, data, timeout: None }
    };
    assert_eq!(world.ask(write("0x6131:1", PSI.to_le_bytes().to_vec())), Outcome::Done);
    assert_eq!(unit(&world, "pressure"), "psi");
    assert_eq!(world.ask(write("0x6132:1", vec![2])), Outcome::Done);
    assert_eq!((world.events("unit_changed"), world.events("digits_changed")), (2, 2), "for each tag");
    world.run_for(300);
    assert!((world.number(2, "pressure_pa") - 1e7).abs() < 2e5, "{}", world.number(2, "pressure_pa"));
    assert!(matches!(world.ask(write("0x6131:1", vec![1, 2, 3])), Outcome::Aborted(_)));
    assert_eq!(unit(&world, "pressure"), "psi", "what the device refuses changes nothing");
    // The read of the unit is due in 10 s; another master writes mbar before.
    world.say("602#2331610100004EFD");
    world.run_for(300);
    assert_eq!(unit(&world, "pressure"), "mbar");
}

#[test]
fn r_dst_038_other_whole_numbers_have_the_unit_and_digits_that_their_tags_name_and_none_are_assumed() {
    let tags = WHOLE_NUMBERS.map(|(object, channel)| {
        let tag = |name: &str, unit: &str| {
            format!(
                "[[tag]]\nname = \"{name}_{}_{channel}\"\nobject = \"{object}:{channel}\"\npoll_ms = 1000\ntype = \"i32\"\n\
                 decimals = 3\n{unit}",
                &object[2..]
            )
        };
        let unit = if channel == "1" { "kPa" } else { "°C" };
        let told = format!(
            "unit = \"{unit}\"\nunit_object = \"0x6131:{channel}\"\ndigits_object = \"0x6132:{channel}\"\n"
        );
        tag("told", &told) + &tag("plain", "")
    });
    let world = world(&(mapping(DEFAULT, (BAR, 3), (CELSIUS, 2)) + &tags.concat()));
    for (object, channel) in WHOLE_NUMBERS {
        let name = |kind: &str| format!("{kind}_{}_{channel}", &object[2..]);
        let (told, plain) = (world.tag(2, &name("told")), world.tag(2, &name("plain")));
        assert_eq!((told.quality, plain.quality), (Quality::Good, Quality::Good), "{object}:{channel}");
        assert_eq!(plain.raw, told.raw, "{object}:{channel}");
        assert_eq!(plain.value, plain.raw, "{object}:{channel}");
        // Thousandths of a bar as kPa, hundredths of a degree.
        let per_count = if channel == "1" { 0.1 } else { 0.01 };
        let wanted = told.raw.as_f64() * per_count;
        assert!((told.value.as_f64() - wanted).abs() <= wanted.abs() * 1e-9, "{object}:{channel}: {told:?}");
    }
    assert!((world.number(2, "told_9149_1") - 40_000.0).abs() < 1e-6);
    assert!(world.number(2, "told_9149_2") > 1.0);
}

#[test]
fn the_units_of_a_device_are_shown_where_users_look() {
    let text = mapping(DEFAULT, (PSI, 2), (CELSIUS, 0)).replace(
        "name = \"pressure\"\n",
        "name = \"pressure\"\nregisters = [{ address = 100, type = \"f32\" }]\n",
    );
    let world = world(&text);
    let view = NodeView::new(&world.table, &world.image, NodeIndex(0), world.now().instant).unwrap();
    let json = serde_json::to_value(view).unwrap();
    let unit = |name: &str| {
        let tags = json["tags"].as_array().unwrap();
        tags.iter().find(|tag| tag["name"] == name).unwrap()["unit"].clone()
    };
    assert_eq!((unit("pressure"), unit("pressure_pa")), ("psi".into(), "Pa".into()));
    let map = RegisterMap::build(&world.table, &ModbusSettings::default(), "cangate").unwrap();
    let point = map.points().iter().find(|point| point.tag == "pressure").unwrap();
    assert_eq!(point.engineering_unit, "device");
    assert!(point.description.ends_with("(in the device's unit)"), "{}", point.description);
}

#[test]
fn mistakes_about_units_are_told_with_the_way_out() {
    let good = mapping(DEFAULT, (BAR, 3), (CELSIUS, 0));
    assert!(check_mapping(&SourceText::new("own", good.as_str())).is_ok());
    let float = mapping(r#""0x6130:1/32""#, (BAR, 3), (CELSIUS, 0));
    for (text, right, wrong, message) in [
        (&good, "unit = \"Pa\"", "unit = \"inch\"", "cannot be converted to `inch`"),
        (&good, "unit = \"Pa\"", "", "nothing says in which unit `pressure_pa` is to be shown"),
        (
            &good,
            "unit_object = \"0x6131:1\"\n",
            "",
            "`pressure` is in the device's unit, but nothing says where",
        ),
        (&good, "unit_object = \"0x6131:1\"", "unit_object = \"6131\"", "does not name an object"),
        (
            &good,
            "digits_object",
            "scale = { divide = 10 }\ndigits_object",
            "both `scale` and `digits_object`",
        ),
        (&float, "unit_object", "digits_object = \"0x6132:1\"\nunit_object", "is no whole number"),
    ] {
        let broken = text.replacen(right, wrong, 1);
        assert_ne!(&broken, text);
        let problems = check_mapping(&SourceText::new("own", broken.as_str())).unwrap_err();
        let told: Vec<String> = problems.iter().map(ToString::to_string).collect();
        assert!(
            told.iter().any(|line| line.contains(message) && line.contains("hint: ")),
            "{wrong}: {told:#?}"
        );
    }
}
