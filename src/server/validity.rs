//! Reads when a certificate expires. The library that verifies certificates does not expose that.

/// A day, s.
pub(super) const DAY_S: i64 = 86_400;

const SEQUENCE: u8 = 0x30;
const UTC_TIME: u8 = 0x17;
const GENERALIZED_TIME: u8 = 0x18;
/// The tag of the version, a field that certificates of version 1 lack.
const VERSION: u8 = 0xa0;

/// Returns when a certificate (X.509 in DER, RFC 5280) expires, s since 1970; `None` if it can't be parsed.
pub(super) fn expires_s(certificate: &[u8]) -> Option<i64> {
    let (certificate, _) = element(certificate, Some(SEQUENCE))?;
    let (mut rest, _) = element(certificate, Some(SEQUENCE))?;
    if rest.first() == Some(&VERSION) {
        rest = element(rest, None)?.1;
    }
    // Skips serial number, algorithm and issuer.
    for _ in 0..3 {
        rest = element(rest, None)?.1;
    }
    let (validity, _) = element(rest, Some(SEQUENCE))?;
    let (_, not_after) = element(validity, None)?;
    let kind = *not_after.first()?;
    let (text, _) = element(not_after, None)?;
    time_s(kind, text)
}

/// Returns the contents of the first element and the bytes after it; `None` if it is truncated or not of `kind`, if
/// that is given.
fn element(bytes: &[u8], kind: Option<u8>) -> Option<(&[u8], &[u8])> {
    let (&first, &length) = (bytes.first()?, bytes.get(1)?);
    if kind.is_some_and(|kind| kind != first) {
        return None;
    }
    let (length, head) = match usize::from(length) {
        short @ ..0x80 => (short, 2),
        long => {
            let digits = bytes.get(2..2 + (long & 0x7f))?;
            if digits.is_empty() || digits.len() > 4 {
                return None;
            }
            (digits.iter().fold(0, |length, &digit| length << 8 | usize::from(digit)), 2 + digits.len())
        }
    };
    let rest = &bytes[head..];
    Some((rest.get(..length)?, rest.get(length..)?))
}

/// Parses a time, `YYMMDDhhmmssZ` or with a year of four digits. Returns s since 1970.
fn time_s(kind: u8, text: &[u8]) -> Option<i64> {
    let number = |from: usize, count: usize| -> Option<i64> {
        let digits = std::str::from_utf8(text.get(from..from + count)?).ok()?;
        digits.bytes().all(|digit| digit.is_ascii_digit()).then(|| digits.parse().ok()).flatten()
    };
    let (year, at) = match kind {
        UTC_TIME => (number(0, 2).map(|year| if year < 50 { 2000 + year } else { 1900 + year })?, 2),
        GENERALIZED_TIME => (number(0, 4)?, 4),
        _ => return None,
    };
    let (month, day) = (number(at, 2)?, number(at + 2, 2)?);
    let (hours, minutes, seconds) = (number(at + 4, 2)?, number(at + 6, 2)?, number(at + 8, 2)?);
    // Days since 1 March of the year 0, in a calendar whose years begin in March: the leap day is each year's last.
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = 365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 1;
    Some((days - 719_468) * DAY_S + 3600 * hours + 60 * minutes + seconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_expiry_of_a_certificate_is_found() {
        for (year, month, day, expires) in [
            (2024, 2, 29, 1_709_164_800),
            (2049, 12, 31, 2_524_521_600),
            (2050, 1, 1, 2_524_608_000),
            (1999, 3, 1, 920_246_400),
        ] {
            let mut params = rcgen::CertificateParams::default();
            params.not_before = rcgen::date_time_ymd(1990, 1, 1);
            params.not_after = rcgen::date_time_ymd(year, month, day);
            let key = rcgen::KeyPair::generate().unwrap();
            let certificate = params.self_signed(&key).unwrap();
            assert_eq!(expires_s(certificate.der()), Some(expires));
            // A truncated certificate has no expiry.
            let bytes = certificate.der();
            for length in 0..bytes.len() {
                assert!(expires_s(&bytes[..length]).is_none());
            }
        }
    }
}
