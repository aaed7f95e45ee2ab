//! The reduced validation suite: the checks of `kesi validate --quick`.

use kesi::validate;

#[test]
fn every_row_of_the_reduced_validation_holds() {
    let checks = validate::suite(true);
    let findings = validate::run(&checks, 2, 1, &|_, _| {}, &mut |_, _| {});
    let failed: Vec<_> = findings.iter().flat_map(|f| &f.rows).filter(|r| !r.pass).collect();
    assert!(failed.is_empty(), "{failed:#?}");
    assert!(findings.iter().all(|f| !f.rows.is_empty()), "every check has rows");
}
