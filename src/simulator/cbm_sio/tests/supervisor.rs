//! Supervisor commands: exact parameters, one module and all (R-ESD-071, R-ESD-072, R-ESD-108).

use super::bench::Bench;

/// Module 12 after its bits were cleared.
fn known() -> Bench {
    let mut bench = Bench::sio4(0x12);
    bench.frame("700#810200120000");
    bench
}

fn suspended(bench: &mut Bench) -> bool {
    matches!(bench.ask("700#010200120567").as_str(), "567#0102C3" | "567#010243")
}

#[test]
fn r_esd_071_only_exact_parameters_count() {
    for frame in
        ["FF0000120000", "FF000012AA00", "FF00001200AA", "FF0300125555", "FF00001255AA", "FF030012AA55"]
    {
        let mut bench = known();
        bench.frame(&format!("700#{frame}"));
        assert!(!bench.says("new on bus"), "{frame}");
    }
    let mut bench = known();
    for frame in ["FF0400120000", "FF0400125AA5", "FF040012AAAA"] {
        bench.frame(&format!("700#{frame}"));
        assert!(!suspended(&mut bench), "{frame}");
    }
    bench.frame("700#FF0400125A5A");
    bench.frame("700#FF0400125A5A");
    assert!(suspended(&mut bench));
    bench.frame("700#FF040012A55A");
    assert!(suspended(&mut bench));
    bench.frame("700#FF040012A5A5");
    assert!(!suspended(&mut bench));
}

#[test]
fn r_esd_072_number_00_is_all_modules_for_supervisor_commands_only() {
    let mut bench = known();
    bench.frame("700#FF0400005A5A");
    assert!(suspended(&mut bench));
    bench.frame("700#FF040000A5A5");
    assert!(!suspended(&mut bench));
    bench.order("error");
    bench.frame("700#FF0500000000");
    assert!(!bench.says("can error"));
    bench.frame("700#820000000345");
    assert_eq!(bench.ask("700#020000120567"), "567#020000B4");
    bench.frame("700#FF0000FEAAAA");
    assert!(!bench.says("new on bus"), "another module");
}

#[test]
fn r_esd_108_a_reset_of_all_gives_defaults_only_where_the_switches_are_at_00() {
    for (switch, stored) in [("12", true), ("00", false)] {
        let mut bench = known();
        bench.talk(&[("700#820000120345", "-"), ("700#810000121200", "-")]);
        bench.order(&format!("switch {switch}"));
        bench.frame("700#FF000000AAAA");
        bench.order("switch 12");
        bench.run_for(10_000);
        let answer = if stored { "567#02000345" } else { "567#020000B4" };
        assert_eq!(bench.ask("700#020000120567"), answer, "{switch}");
    }
}
